# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Three frames together: their derivatives, and whether threes agree."""

from copy import copy

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from rs_localizer.estimation import frames_together as together

from .frames import differences

CAMERA = rsl.Camera(640, 480, [[500, 0, 320], [0, 490, 240], [0, 0, 1]], readout_time=0.03)
TIMES = (0, 33_000_000, 70_000_000)  # ns, of unlike intervals


def three_frames():
    """Points before a camera that turns and moves, as pinhole pixels of each frame's middle row."""
    rng, posed = np.random.default_rng(4), []
    points = rng.uniform((-1.0, -0.8, 3.0), (1.0, 0.8, 5.0), (30, 3))
    for k, time_ns in enumerate(TIMES):
        turn = Rotation.from_rotvec(0.03 * (k + 1) * np.array([1.0, -2.0, 0.5])).as_matrix()
        pixels = CAMERA.project(points @ turn.T + 0.05 * k)
        found = rsl.Localizer(CAMERA).localize(points, pixels)
        posed.append(together.Fitted(time_ns, found, points, pixels))
    return posed


@pytest.mark.parametrize("k", range(3))
def test_derivatives_are_finite_differences(k):
    posed, principal = three_frames(), np.array([0.6, 0.5])
    landmarks = together._Landmarks.of(posed[0].points)
    three = together._Three(rsl.Localizer(CAMERA)._exposure, posed, landmarks, 0.0)

    def lines(step):
        there = copy(three)
        there.own = np.zeros(25)
        there._move(step[:25])
        return there.lines(k, step[25:], principal)

    _, columns = lines(np.zeros(36))
    expected = differences(lambda step: lines(step)[0], 36, 1e-5)
    scale = np.abs(expected).max(axis=(0, 1))
    # By focal length and aspect ratio the motion between two rows is left out: some 4 %.
    most = np.repeat([1e-3, 0.05, 1e-3], [26, 2, 8])
    np.testing.assert_array_less(np.abs(columns - expected).max(axis=(0, 1)) / scale, most)


def test_threes_scatter_as_much_as_their_equations_say_or_deviations_grow():
    """Of threes that know shared numbers to 1 %, and show them elsewhere by so many times that."""
    rng, nothing, known = np.random.default_rng(1), np.zeros(25), np.zeros((11, 11))
    known[:3, :3] = 1e4 * np.eye(3)

    def disagreement(times: float, count: int = 8) -> float:
        shown = times * 0.01 * rng.normal(size=(count, 3))
        shown -= shown.mean(axis=0)  # about their mean
        pulls = np.hstack([shown, np.zeros((count, 8))]) @ known
        numbers = np.zeros(11)
        threes = [
            together._Equations(numbers, known, pull, nothing, known, nothing) for pull in pulls
        ]
        return together._disagreement(threes, numbers)

    assert disagreement(100.0, count=1) == disagreement(0.3) == 1.0
    many = [disagreement(5.0) for _ in range(100)]
    assert np.sqrt(np.mean(np.square(many))) == pytest.approx(5.0, rel=0.1)
