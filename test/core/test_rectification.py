# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rectified pixels are those of a global shutter, by a projector of the test's own."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl

K = np.array([[500.0, 0.0, 319.5], [0.0, 480.0, 239.5], [0.0, 0.0, 1.0]])
OMEGA, V = np.array([0.1, -0.25, 0.15]), np.array([0.05, -0.03, 0.08])  # per readout
RNG = np.random.default_rng(0)
POINTS = RNG.uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 6.0], (60, 3))
MOTION = rsl.Motion(Rotation.from_rotvec([0.1, 0.2, -0.1]).as_matrix(), np.zeros(3), OMEGA, V)


def before(tau: float, points: Any) -> Any:
    """Points in the camera's axes at a row time: it has flown straight, turning steadily."""
    start = points @ MOTION.rotation.T + MOTION.translation
    return (start - tau * V) @ Rotation.from_rotvec(-tau * OMEGA).as_matrix().T


def seen(camera: rsl.Camera, point: Any) -> tuple[Any, float]:
    """Pixel and depth by a rolling shutter: the row that sees the point, by bisection."""
    low, high = -0.7, 0.7
    for _ in range(60):
        tau = 0.5 * (low + high)
        pixel = camera.project(before(tau, point[None]))[0]
        if camera.row_time(pixel[None])[0] > tau:
            low = tau
        else:
            high = tau
    return pixel, float(before(tau, point[None])[0, 2])


@pytest.mark.parametrize(
    ("tau", "direction"), [(0.0, "top_to_bottom"), (-0.5, "right_to_left"), (0.37, "bottom_to_top")]
)
def test_with_depths_pixels_are_exact(tau, direction):
    D = [-0.2, 0.05, 1e-3, -1e-3]
    camera = rsl.Camera(640, 480, K, D, readout_time=0.03, scan_direction=direction)
    found = [seen(camera, point) for point in POINTS]
    pixels, depths = np.array([p for p, _ in found]), np.array([d for _, d in found])
    expected = camera.project(before(tau, POINTS))
    rectified = rsl.rectify(camera, MOTION, pixels, depths, tau)
    np.testing.assert_allclose(rectified, expected, atol=1e-4)
    assert np.abs(pixels - expected).max() > 10.0  # there is something to undo


def test_without_depths_it_is_exact_for_what_is_far_away():
    camera = rsl.Camera(640, 480, K, readout_time=0.03)
    far = 1e6 * POINTS
    pixels = np.array([seen(camera, point)[0] for point in far])
    expected = camera.project(before(0.0, far))
    np.testing.assert_allclose(rsl.rectify(camera, MOTION, pixels), expected, atol=1e-3)
    np.testing.assert_allclose(
        rsl.rectify(camera, MOTION, pixels, np.inf), rsl.rectify(camera, MOTION, pixels)
    )
