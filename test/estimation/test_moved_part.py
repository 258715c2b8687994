# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A part of the map that was moved is named by its ids; lenses and declared errors are not."""

import copy
import re
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from benchmarks import kinds
from benchmarks.frames.gross import frame
from rs_localizer.config import NodeConfig
from rs_localizer.tracking import Tracker

from ..moving import pinhole  # noqa: TID252 - Python has a package "test"

CAMERA = pinhole(520.0)


def said(fault: kinds.Fault, **fields: Any) -> tuple[set[int], set[int], str]:
    """Return the ids that were moved and those that are named, and the sentence."""
    moved: set[int] = set()

    def observed(seen: kinds.Seen, rng: np.random.Generator) -> kinds.Seen:
        told = fault(seen, rng)
        moved.clear()
        moved.update(np.flatnonzero((told.points != seen.points).any(axis=1)).tolist())
        return told

    kind = kinds.Kind("half map moved 1 cm, corner", kinds._corner, observed, **fields)
    text = kinds.judged(kind, 3).texts.get("stale_landmarks", "")
    ids = text.rpartition(": ")[2].removesuffix(" ...")
    return moved, {int(name) for name in ids.split(", ") if name}, text


def test_half_of_a_map_that_was_moved_is_named_with_its_ids():
    moved, named, text = said(partial(kinds.part_moved, 0.5, 0.01))
    assert len(named) >= 8
    assert named <= moved or named.isdisjoint(moved)  # either half may be the one that was moved
    words = re.match(r"\d+ landmarks in view lie together .*?([\d.]+) mm", text)
    assert abs(float(words[1]) - 10.0) < 3.0


@pytest.mark.parametrize("distance", [0.02, 0.3])
def test_regions_hold_whichever_half_was_moved(distance):
    """Within the gates of inliers, and beyond all of them."""
    fault = partial(kinds.part_moved, 0.5, distance)
    found = kinds.judged(kinds.Kind("half map moved", kinds._room, fault), 1)
    assert found.published > 50
    assert found.inside[0] > 0.9 * found.published
    assert found.beyond == 0


@pytest.mark.parametrize(
    "fault",
    [
        kinds.right,
        partial(kinds.squeezed, 1.0, 0.98),
        partial(kinds.rectified, 1.0),
        partial(kinds.stretched, 0.01),
    ],
)
def test_no_landmark_is_named_for_a_lens_or_a_map_that_is_stretched(fault):
    assert said(fault, camera=kinds._MILD)[1:] == (set(), "")


def test_a_declared_deviation_explains_what_it_is_as_large_as():
    declared = NodeConfig(map_deviation=0.005)
    assert said(partial(kinds.part_moved, 0.5, 0.01), settings=declared)[2] == ""


@pytest.mark.parametrize("first", [0, 200])
def test_a_camera_that_turns_on_the_spot_finds_the_part(first):
    """At once; of a long track when it is searched again, a step a frame."""
    random = np.random.default_rng(1)
    camera, points, pixels, _ = frame("volume", "right", random)
    half = points[:, 0] > np.median(points[:, 0])
    told = points + 0.02 * half[:, None] * [0.0, 1.0, 0.0]
    tracker = Tracker(rsl.Localizer(camera), remembers_motion=False)
    rays = np.c_[camera.rays(pixels), np.ones(len(pixels))]
    for k in range(30 + first):
        turn = Rotation.from_rotvec([0.0, 0.01 * (k % 30 - 15), 0.0])
        seen = camera.project(turn.apply(rays)) + random.normal(0.0, 0.1, pixels.shape)
        tracker.localize(10**9 + 33_000_000 * k, points if k < first else told, seen)
        tracker = copy.deepcopy(tracker) if k == first + 3 else tracker
        assert tracker.moved is None or k >= first
    part = tracker.moved
    assert part is not None
    found = (told[:, None] == part.points).all(axis=2).any(axis=1)
    assert max(np.mean(found == half), np.mean(found == ~half)) > 0.9


def test_a_global_shutter_is_no_part_of_a_map():
    """A hand's, set to 30 ms: before that shows, rows are bent, and nothing is said of the map."""
    for seed in range(6):
        random, tracker = np.random.default_rng(seed), Tracker(rsl.Localizer(CAMERA))
        points = random.uniform([-1.5, -1.2, 2.0], [1.5, 1.2, 4.0], (100, 3))
        turning, going = random.normal(0.0, [[0.5], [0.3]], (2, 3))  # rad/s, m/s
        for t in np.arange(12) / 30.0:
            local = Rotation.from_rotvec(t * turning).apply(points) - t * going
            noisy = CAMERA.project(local) + random.normal(0.0, 0.5, (100, 2))
            tracker.localize(10**9 + round(1e9 * t), points, noisy)
            assert tracker.moved is None


def test_a_part_of_which_few_landmarks_are_shown_still_counts():
    """Too few to have a motion of their own, after frames that show more of them."""
    (kind,) = (each for each in kinds.kinds() if each.name == "half map moved 50 cm, room")
    found = kinds.judged(kind, 1)
    assert found.published > 40
    assert found.beyond == 0
