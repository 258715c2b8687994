# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A part of the map that was moved is named by its ids; lenses and declared errors are not."""

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


def said(fault: kinds.Fault, **fields: Any) -> tuple[set[int], set[int], str]:
    """Return the ids that were moved and those that are named, and the sentence."""
    moved: set[int] = set()

    def observed(seen: kinds.Seen, rng: np.random.Generator) -> kinds.Seen:
        told = fault(seen, rng)
        moved.clear()
        moved.update(np.flatnonzero((told.points != seen.points).any(axis=1)).tolist())
        return told

    kind = kinds.Kind("half map moved 1 cm, corner", kinds._corner, observed, **fields)
    text = kinds.judged(kind, 2).texts.get("stale_landmarks", "")
    ids = text.rpartition(": ")[2].removesuffix(" ...")
    return moved, {int(name) for name in ids.split(", ") if name}, text


def test_half_of_a_map_that_was_moved_is_named_with_its_ids():
    moved, named, text = said(partial(kinds.part_moved, 0.5, 0.01))
    assert len(named) >= 8
    assert named <= moved or named.isdisjoint(moved)  # either half may be the one that was moved
    words = text.split()
    assert text.startswith(" ".join([words[0], "landmarks in view lie together"]))
    assert abs(float(words[words.index("mm") - 1]) - 10.0) < 3.0


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


def test_a_camera_that_turns_on_the_spot_finds_the_part():
    random = np.random.default_rng(1)
    camera, points, pixels, _ = frame("volume", "right", random)
    half = points[:, 0] > np.median(points[:, 0])
    told = points + 0.02 * half[:, None] * [0.0, 1.0, 0.0]
    tracker = Tracker(rsl.Localizer(camera), remembers_motion=False)
    centre = camera.K[:2, 2]
    for k in range(30):
        turn = 0.01 * (k - 15)
        away = (pixels - centre) / camera.focal_length
        rays = np.c_[away, np.ones(len(away))]
        rays[:, [0, 2]] = rays[:, [0, 2]] @ [
            [np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]
        ]  # fmt: skip
        seen = rays[:, :2] / rays[:, 2:] * camera.focal_length + centre
        noisy = seen + random.normal(0.0, 0.1, seen.shape)
        tracker.localize(10**9 + 33_000_000 * k, told, noisy)
    part = tracker.moved
    assert part is not None
    own = {tuple(point) for point in part.points.tolist()}
    found = np.array([tuple(point) in own for point in told.tolist()])
    assert max(np.mean(found == half), np.mean(found == ~half)) > 0.9


def test_a_global_shutter_is_no_part_of_a_map():
    """A hand's, set to 30 ms: before that shows, rows are bent, and nothing is said of the map."""
    K = np.array([[520.0, 0.0, 320.0], [0.0, 520.0, 240.0], [0.0, 0.0, 1.0]])
    camera = rsl.Camera(640, 480, K, np.zeros(5), readout_time=0.03)
    named = 0
    for seed in range(6):
        random = np.random.default_rng(seed)
        tracker = Tracker(rsl.Localizer(camera))
        points = random.uniform([-1.5, -1.2, 2.0], [1.5, 1.2, 4.0], (100, 3))
        turning, going = random.normal(0.0, [[0.5], [0.3]], (2, 3))  # rad/s, m/s
        for k in range(12):
            t = k / 30.0
            local = Rotation.from_rotvec(t * turning).apply(points) - t * going
            pixels = local[:, :2] / local[:, 2:] * 520.0 + [320.0, 240.0]
            noisy = pixels + random.normal(0.0, 0.5, pixels.shape)
            tracker.localize(10**9 + round(1e9 * t), points, noisy)
            named += tracker.moved is not None
    assert named == 0


def test_a_part_of_which_few_landmarks_are_shown_still_counts():
    """Too few to have a motion of their own, after frames that show more of them."""
    (kind,) = (each for each in kinds.kinds() if each.name == "half map moved 50 cm, room")
    found = kinds.judged(kind, 1)
    assert found.published > 40
    assert found.beyond == 0
