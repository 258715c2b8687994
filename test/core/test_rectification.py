# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rectified pixels are those of a global shutter, by the independent projector."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from benchmarks.independent.cameras import Camera, Scan

from ..moving import camera_of, shown  # noqa: TID252 - Python has a package "test"

TRUE = Camera(focal=500.0, distortion=(-0.2, 0.05, 1e-3, -1e-3, 0.0))
OMEGA, V = np.array([0.1, -0.25, 0.15]), np.array([0.05, -0.03, 0.08])  # per readout
START = Rotation.from_rotvec([-0.1, -0.2, 0.1])  # map_from_camera
MOTION = rsl.Motion(START.inv().as_matrix(), np.zeros(3), OMEGA, V)
POINTS = np.random.default_rng(0).uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 6.0], (60, 3))


def pose(seconds):
    """It flies straight, turning steadily."""
    tau = seconds[:, None] / TRUE.readout_time
    return START * Rotation.from_rotvec(tau * OMEGA), START.apply(tau * V)


def local(points, tau):
    """Points in the camera's axes, each at its row time."""
    rotation, place = pose(TRUE.readout_time * tau)
    return rotation.inv().apply(points - place)


@pytest.mark.parametrize(("tau", "scan"), [(0.0, Scan.DOWN), (-0.5, Scan.LEFT), (0.37, Scan.UP)])
def test_with_depths_pixels_are_exact(tau, scan):
    true = replace(TRUE, scan=scan)
    camera, pixels = camera_of(true), shown(true, pose, POINTS)
    depths = local(POINTS, camera.row_time(pixels))[:, 2]
    expected = camera.project(local(POINTS, np.full(60, tau)))
    rectified = rsl.rectify(camera, MOTION, pixels, depths, tau)
    np.testing.assert_allclose(rectified, expected, atol=1e-4)
    assert np.abs(pixels - expected).max() > 10.0  # there is something to undo


def test_without_depths_it_is_exact_for_what_is_far_away():
    camera, far = camera_of(TRUE), 1e6 * POINTS
    pixels, expected = shown(TRUE, pose, far), camera.project(local(far, np.zeros(60)))
    rectified = rsl.rectify(camera, MOTION, pixels)
    np.testing.assert_allclose(rectified, expected, atol=1e-3)
    np.testing.assert_allclose(rsl.rectify(camera, MOTION, pixels, np.inf), rectified)
