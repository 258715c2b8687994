# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A known rotation in a frame: against SciPy's splines and its integration of the kinematics."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from rs_localizer.core.rotation_prior import NODES, WHOLE, RotationPrior, compensated, parts_of
from rs_localizer.core.so3 import hat

TAU = np.linspace(-0.8, 0.8, 33)
ROWS = np.linspace(-0.5, 0.5, 7)


def integrated(rate, tau):
    """Rotation (3,3) camera_then_from_camera_at_0 of a body rate."""

    def kinematics(time, rotation):
        return -(hat(rate(time)) @ rotation.reshape(3, 3)).ravel()

    found = solve_ivp(kinematics, (0.0, tau), np.eye(3).ravel(), rtol=1e-12, atol=1e-13)
    return found.y[:, -1].reshape(3, 3)


def known():
    """The rotation with these rates, by its turns at the nodes."""
    shaking = 0.3 * np.column_stack([np.sin(9.0 * TAU), np.cos(5.0 * TAU), 0.4 + TAU])
    spline = CubicSpline(TAU, shaking, bc_type="natural")
    turns = np.array([integrated(spline, tau) for tau in NODES])
    return RotationPrior(*parts_of(turns), np.zeros((WHOLE, WHOLE)), False), spline


def test_rotations_are_the_integral_of_the_rates():
    rotation, spline = known()
    turns, rates = rotation.at_rows(ROWS)
    for tau, turn in zip(ROWS, turns, strict=True):
        np.testing.assert_allclose(turn, integrated(spline, tau), atol=3e-5)
    np.testing.assert_allclose(rates, spline(ROWS), atol=1e-3)


def test_compensated_bearings_are_those_of_the_middle_row():
    rng = np.random.default_rng(1)
    rays, tau = rng.uniform(-0.6, 0.6, (20, 2)), rng.uniform(-0.5, 0.5, 20)
    turn, _ = known()
    by_ray = np.broadcast_to(400.0 * np.eye(2), (20, 2, 2)).copy()
    found, _ = compensated(rays, tau, by_ray, np.zeros(2), turn)
    bearings = np.column_stack([rays, np.ones(20)])
    expected = np.einsum("nji,nj->ni", turn.at_rows(tau)[0], bearings)
    np.testing.assert_allclose(found, expected[:, :2] / expected[:, 2:], atol=1e-14)


def test_derivatives_of_compensated_bearings_by_differences():
    """Noise of the pixel moves the bearing and, with the row time, the turn."""
    (turn, _), gradient, step = known(), np.array([3e-4, 2e-3]), 1e-4
    ray, tau, focal = np.array([0.2, -0.3]), 0.21, 400.0

    def steady(pixel):  # where a pixel's own row time puts its bearing
        later = tau + gradient @ (pixel - focal * ray)
        return compensated(
            pixel[None] / focal, np.array([later]), np.zeros((1, 2, 2)), gradient, turn
        )[0][0]

    steps = step * np.eye(2)
    changes = [steady(focal * ray + one) - steady(focal * ray - one) for one in steps]
    by_pixel = np.array(changes).T / (2.0 * step)
    _, found = compensated(ray[None], np.array([tau]), focal * np.eye(2)[None], gradient, turn)
    np.testing.assert_allclose(found[0] @ by_pixel, np.eye(2), atol=1e-6)
