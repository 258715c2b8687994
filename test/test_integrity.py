# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The chance of a wrong pose or map rises by what only those leave, and falls again."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rs_localizer as rsl
from benchmarks.integrity import SCENES, recursive, sequence
from rs_localizer.config import Acceleration
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.prior import Prior
from rs_localizer.integrity import Integrity, SeenLandmarks

from .moving import AT_REST, estimate_at

EXAMPLES = Path(__file__).parents[1] / "examples"
RNG = np.random.default_rng(0)
FRAME = 1.0 / 30.0  # s
POINTS = RNG.uniform([-3.0, -3.0, 3.0], [3.0, 3.0, 9.0], (120, 3))


def estimate(kept: Any, tracked: bool = True) -> Estimate:
    residuals = np.where(kept, np.abs(RNG.normal(0.0, 0.5, len(kept))), 9.0)
    return estimate_at(inliers=np.asarray(kept), residuals=residuals, tracked=tracked)


def run(frames: Iterable[Any], jumps: tuple[int, ...] = (), unseen: float = FRAME) -> list[float]:
    """Doubts after frames of which these points were kept; some are half a metre aside."""
    judge, doubts = Integrity(Acceleration()), []
    for i, kept in enumerate(frames):
        seconds, prior = unseen if i in jumps else FRAME, None
        if jumps:
            aside = [0.5 if i in jumps else 0.005, 0.0, 0.0]  # m, known to a centimetre
            motion = replace(AT_REST, translation=np.array(aside))
            prior = Prior(motion=motion, covariance=1e-4 * np.eye(12))
        numbers = judge.numbers(estimate(kept, i > 0), POINTS, prior, seconds)
        doubts.append(judge.add(numbers, seconds))
    return doubts


def anywhere(count: int) -> Any:
    return RNG.random((count, 120)) < 0.8


def near(count: int) -> Any:
    """Only a quarter fits, about one place of the room: as a part of another room would."""
    far = np.linalg.norm(POINTS - POINTS[0], axis=1)
    return [far < np.quantile(far, 0.25)] * count


def test_chance_outliers_are_no_doubt_and_a_part_that_fits_alone_is():
    right, wrong = run(anywhere(15)), run(near(15))
    half = run([POINTS[:, 0] > 0.0] * 15)  # the other was moved: mostly, the pose is right
    assert max(right[5:]) < 0.02
    assert min(half[3:]) > 3.0 * max(right[5:])
    assert max(half) < 0.5 < wrong[-1]


def test_doubt_falls_again():
    doubts = run([*near(10), *anywhere(15)])
    assert doubts[9] > 0.2
    assert doubts[-1] < 0.05


def test_a_pose_that_jumps_is_doubted_until_it_jumps_back():
    doubts = run(anywhere(40), jumps=(10, 30))
    assert max(doubts[:10]) < 0.05
    assert min(doubts[10:30]) > 0.5  # a map that is wrong everywhere alike shows nothing else
    assert max(doubts[31:]) < 0.5
    assert doubts[31] < doubts[29]


def test_a_hand_that_was_out_of_sight_has_not_jumped():
    """In 0.7 s it moves by half a metre at 2 m/s^2, of the 4 that settings allow."""
    assert max(run(anywhere(40), jumps=(10, 30), unseen=0.7)) < 0.05


@pytest.mark.parametrize("rate", [10.0, 30.0, 100.0])
def test_a_camera_that_was_carried_is_doubted_for_a_second_at_any_rate(rate):
    """One jump, and right images ever since; before it nothing, however often images come."""
    judge = Integrity(Acceleration())
    right = np.array([0.0, 0.0, 4.0, 0.0])  # nothing clusters, all of the map, sixty points
    jump = right + np.array([0.0, 0.0, 0.0, 5.0])
    before = [judge.add(right, 1.0 / rate) for _ in range(round(3.0 * rate))]
    doubts = [judge.add(jump, 1.0 / rate)]
    doubts += [judge.add(right, 1.0 / rate) for _ in range(round(3.0 * rate))]
    assert max(before[-10:]) < 0.01
    assert 0.6 < np.sum(np.array(doubts) > 0.5) / rate < 1.2
    assert doubts[-1] < 0.35
    judge.add(jump, 1.0 / rate)
    judge.reset()
    assert judge.add(right, 1.0 / rate) < 0.1


def test_landmarks_that_are_never_matched_are_named_and_no_others():
    judge, gone = Integrity(Acceleration()), np.arange(120) < 5
    for i in range(60):
        kept = (RNG.random(120) < 0.5) & ~gone
        judge.numbers(estimate(kept, i > 0), POINTS, None, FRAME)
        if i == 5:
            assert not judge.stale(POINTS).any()  # six misses of half say nothing
    assert np.array_equal(judge.stale(POINTS), gone)
    judge.reset()
    assert np.array_equal(judge.stale(POINTS[::-1]), gone[::-1])
    assert not judge.stale(POINTS + 1.0).any()


def test_a_landmark_that_comes_twice_in_an_image_takes_no_place_of_another(monkeypatch):
    monkeypatch.setattr("rs_localizer.integrity._MOST_LANDMARKS", 5)
    seen = SeenLandmarks()
    seen.add(np.arange(10.0), np.arange(10) != 3)
    for _ in range(30):
        seen.add(np.array([1.0, 1.0, 2.0, 3.0]), np.array([True, True, True, False]))
        seen.add(np.array([77.0]), np.array([True]))
    assert seen.stale(np.array([3.0, 77.0])).tolist() == [True, False]


def test_a_landmark_that_has_been_matched_once_is_there():
    seen, keys = SeenLandmarks(), np.arange(10.0)
    assert not seen.stale(keys).any()
    for i in range(100):
        seen.add(keys, (keys > 1) | ((keys == 0) & (i == 50)))
    assert np.flatnonzero(seen.stale(keys)).tolist() == [1]


@pytest.mark.parametrize("scene", SCENES)
def test_right_maps_are_not_doubted_wherever_matches_lie(scene):
    rows = [row for number in range(900, 906) for row in sequence(number, ("right",), scene)]
    said, right = recursive(rows), np.array([not row.wrong for row in rows])
    assert np.sum(right) > 15
    assert np.all(said[right] < 0.5)
    assert np.mean(said[right] > 0.05) < 0.1


def test_a_board_that_leaves_the_view_ends_nothing():
    """Its last corners determine a motion so badly that a matrix has no inverse in numbers."""
    assert sequence(2049, ("right",), "board")


def test_a_right_scene_in_the_middle_of_the_image_is_not_doubted(monkeypatch):
    """A fifth of the matches is wrong: the scene of the examples, which users start with."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    from moving_camera import HEIGHT, READOUT, WIDTH, K, Moving, matches, scene

    camera = rsl.Camera(WIDTH, HEIGHT, K, readout_time=READOUT)
    tracker, doubts = rsl.Tracker(rsl.Localizer(camera)), []
    moving, points = Moving((0.1, -0.2, 0.0)), scene(150)
    for k in range(300):
        found, seen = matches(moving, points, k / 30.0, seed=k)
        doubts.append(tracker.localize(10**9 + k * 33_333_333, found, seen).integrity)
    assert max(doubts) < 0.05
