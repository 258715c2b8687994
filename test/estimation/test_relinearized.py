# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Derivatives of pixels where a motion sees the points: without the noise of the points."""

import numpy as np
import pytest

from rs_localizer.core.camera import Camera
from rs_localizer.core.gyro_rotation import GyroRotation
from rs_localizer.core.rig import Rig
from rs_localizer.core.simd.tracing import LANES
from rs_localizer.core.types import Motion
from rs_localizer.estimation.observations import find_usable, packed, relinearized
from rs_localizer.estimation.prior import state_in

K = np.array([[250.0, 0.0, 319.5], [0.0, 250.0, 239.5], [0.0, 0.0, 1.0]])
FISHEYE = Camera(
    640, 480, K, np.array([0.02, -0.01, 0.0, 0.0]), distortion_model="equidistant",
    readout_time=0.03,
)  # fmt: skip
EXPOSURE = Rig.of(FISHEYE).exposure()
STILL = Motion(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
TAU = np.linspace(-0.7, 0.7, 29)
TURN = GyroRotation.of(TAU, np.tile([0.1, -0.2, 0.15], (29, 1)), 1e-8 * np.eye(6))


def seen(count, turn=None, seed=0):
    """Points (n,3) and exact pixels (n,2) of a camera that does nothing but the turn."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(20.0, FISHEYE.size - np.array(20.0), (count, 2))
    local = np.column_stack([FISHEYE.rays(pixels), np.ones(count)])
    if turn is not None:
        local = np.einsum("nji,nj->ni", turn.at_rows(FISHEYE.row_time(pixels))[0], local)
    # On the walls of a room.
    return 1.8 * local / np.abs(local).max(axis=1, keepdims=True), pixels


def by_ray(observations):
    """(n,4) of packed points."""
    lanes = observations.packed.reshape(len(observations.packed), -1, LANES)
    return np.moveaxis(lanes[:, 6:10], 1, 2).reshape(-1, 4)[: len(observations)]


@pytest.mark.parametrize("turn", [None, TURN], ids=["fisheye", "and a known turn"])
def test_derivatives_are_those_of_exact_points(turn):
    points, pixels = seen(400, turn)
    noisy = pixels + np.random.default_rng(1).normal(size=pixels.shape)
    # Its corners see 93 degrees; beside a known turn there is what lies ahead.
    exposure = EXPOSURE if turn is None else EXPOSURE.ahead()

    def observed(measured):
        usable = find_usable(exposure, points, measured, [len(points)], turn)
        assert len(usable.indices) == len(points)
        return packed(exposure, points, usable), usable.centre

    exact, _ = observed(pixels)
    measured, centre = observed(noisy)
    found = relinearized(exposure, measured, state_in(STILL, centre), turn)
    before = np.abs(by_ray(measured) - by_ray(exact)).max()
    after = np.abs(by_ray(found) - by_ray(exact)).max()
    assert after < 0.1 * before
    np.testing.assert_array_equal(found.rays, measured.rays)
    np.testing.assert_array_equal(found.tau, measured.tau)
