# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Derivatives by all 18 parameters and by the shaking, against a projection of the tests' own."""

import numpy as np
import pytest

from rs_localizer.core.rig import Mounts
from rs_localizer.estimation import projection
from rs_localizer.estimation.points import Observations

from .frames import alike
from .projection import (
    ALONE,
    AXIS,
    MOUNTED,
    STILL,
    disturbed,
    gradient,
    jacobian_of,
    pixels_of,
    project,
    row_time,
    scene,
    shake,
)

DIRECTIONS = list(AXIS)
SHAKE = 0.003 * np.random.default_rng(7).normal(size=(4, 3))


def packed(points, rays, direction, shift=0.0, seat=ALONE):
    """Points as measured at their pixels and ``shift`` (n,2) px beside them, to first order."""
    by_ray = jacobian_of(rays)
    moved = rays + np.linalg.solve(by_ray, np.broadcast_to(shift, rays.shape)[..., None])[..., 0]
    tau = row_time(pixels_of(moved), direction)
    # Beside another camera, of which there are no points.
    axes, centres = (np.stack(both) for both in zip(ALONE, seat, strict=True))
    mounts = Mounts(axes, centres, np.stack([np.ones(2), gradient(direction)]))
    second = np.ones(len(points), np.int64)
    made = Observations.of(points, moved, tau, jacobian_of(moved), mounts, second)
    return made.packed, tau


def numerical(state, points, direction, coefficients=STILL, h=1e-5, seat=ALONE):
    """Derivatives (n,2,18) of the pixels by a step."""
    columns = []
    for e in np.eye(18):
        ahead, behind = (
            pixels_of(
                project(disturbed(state, sign * h * e), points, direction, coefficients, seat=seat)[
                    0
                ]
            )
            for sign in (1, -1)
        )
        columns.append((ahead - behind) / (2 * h))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("seat", [ALONE, MOUNTED], ids=["alone", "mounted"])
def test_normal_equations_are_those_of_the_forward_projection(direction, seat):
    state, points = scene(direction)
    rays, _ = project(state, points, direction, seat=seat)
    jacobian = numerical(state, points, direction, seat=seat)
    shift = np.array([2e-3, -3e-3])
    data, _ = packed(points, rays, direction, shift, seat)
    information, slope = np.empty((18, 18)), np.empty(18)
    cost = projection.normal_equations(data, state, 100.0, 0.0, 2, information, slope)
    assert cost == pytest.approx(len(points) * shift @ shift, rel=1e-3)
    expected = np.einsum("nci,ncj->ij", jacobian, jacobian)
    scale = np.sqrt(np.diag(expected))
    alike(information, expected, scale, atol=1e-4)
    alike(slope, np.einsum("nci,c->i", jacobian, -shift), scale, atol=1e-4)


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("coefficients", [STILL, SHAKE], ids=["still", "shaking"])
@pytest.mark.parametrize("seat", [ALONE, MOUNTED], ids=["alone", "mounted"])
def test_lines_are_those_of_the_forward_projection(direction, coefficients, seat):
    state, points = scene(direction, seed=1)
    rays, tau = project(state, points, direction, coefficients, seat=seat)
    data, measured = packed(points, rays, direction, seat=seat)
    np.testing.assert_allclose(measured, tau, atol=1e-12)
    h = 1e-5
    rates = (shake(tau + h, coefficients) - shake(tau - h, coefficients)) / (2 * h)
    turns = np.column_stack([shake(tau, coefficients), rates])
    errors, by_motion, by_turn, seen, image = projection.linearized(data, len(points), state, turns)
    np.testing.assert_allclose(errors, 0.0, atol=1e-7)
    np.testing.assert_allclose(seen, tau, atol=1e-9)
    np.testing.assert_allclose(image, rays, atol=1e-9)
    expected = numerical(state, points, direction, coefficients, seat=seat)
    scale = np.abs(expected).max(axis=(0, 1))
    # The rate of the shaking stands for the body rate that it makes.
    near = 1e-3 if len(coefficients) else 2e-5
    np.testing.assert_allclose(by_motion / scale, expected / scale, atol=near)
    # By a turn of the camera in its own axes, over all rows alike: the pixel's own row moves, too.
    columns = []
    for axis in np.eye(3):
        ahead, behind = (
            pixels_of(
                project(state, points, direction, coefficients, sign * h * axis, seat=seat)[0]
            )
            for sign in (1, -1)
        )
        columns.append((ahead - behind) / (2 * h))
    expected = np.stack(columns, axis=-1)
    np.testing.assert_allclose(by_turn, expected, atol=near * np.abs(expected).max())
