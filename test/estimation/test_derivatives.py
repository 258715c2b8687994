# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Derivatives by all 18 parameters and by the shaking, against a projection of the tests' own."""

from functools import partial

import numpy as np
import pytest

from rs_localizer.core.rig import Mounts
from rs_localizer.estimation import projection
from rs_localizer.estimation.points import Observations

from . import projection as own
from .frames import alike, box, differences

DIRECTIONS = list(own.AXIS)
SHAKEN = partial(own.shake, coefficients=0.003 * np.random.default_rng(7).normal(size=(4, 3)))


def packed(points, rays, direction, shift=0.0, seat=own.ALONE):
    """Points as measured at their pixels and ``shift`` (n,2) px beside them, to first order."""
    by_ray = own.jacobian_of(rays)
    moved = rays + np.linalg.solve(by_ray, np.broadcast_to(shift, rays.shape)[..., None])[..., 0]
    tau = own.row_time(own.pixels_of(moved), direction)
    # Beside another camera, of which there are no points.
    axes, centres = (np.stack(both) for both in zip(own.ALONE, seat, strict=True))
    mounts = Mounts(axes, centres, np.stack([np.ones(2), own.gradient(direction)]))
    second = np.ones(len(points), np.int64)
    return Observations.of(points, moved, tau, own.jacobian_of(moved), mounts, second).packed, tau


def derivative(state, points, direction, **more):
    """Derivatives (n,2,18) of the pixels by a step."""

    def pixels(step):
        return own.pixels_of(own.project(own.disturbed(state, step), points, direction, **more)[0])

    return differences(pixels, 18, 1e-5)


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("seat", [own.ALONE, own.MOUNTED], ids=["alone", "mounted"])
def test_normal_equations_are_those_of_the_forward_projection(direction, seat):
    state, points = box(0, 0.1, 40, 0.05)
    rays, _ = own.project(state, points, direction, seat=seat)
    jacobian = derivative(state, points, direction, seat=seat)
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
@pytest.mark.parametrize("swing", [own.steady, SHAKEN], ids=["still", "shaking"])
@pytest.mark.parametrize("seat", [own.ALONE, own.MOUNTED], ids=["alone", "mounted"])
def test_lines_are_those_of_the_forward_projection(direction, swing, seat):
    state, points = box(1, 0.1, 40, 0.05)
    rays, tau = own.project(state, points, direction, swing, seat=seat)
    data, measured = packed(points, rays, direction, seat=seat)
    np.testing.assert_allclose(measured, tau, atol=1e-12)
    h = 1e-5
    turns = np.column_stack([swing(tau), (swing(tau + h) - swing(tau - h)) / (2 * h)])
    errors, by_motion, by_turn, seen, image = projection.linearized(data, len(points), state, turns)
    np.testing.assert_allclose(errors, 0.0, atol=1e-7)
    np.testing.assert_allclose(seen, tau, atol=1e-9)
    np.testing.assert_allclose(image, rays, atol=1e-9)
    expected = derivative(state, points, direction, swing=swing, seat=seat)
    scale = np.abs(expected).max(axis=(0, 1))
    # The rate of the shaking stands for the body rate that it makes.
    near = 2e-5 if swing is own.steady else 1e-3
    np.testing.assert_allclose(by_motion / scale, expected / scale, atol=near)

    def turned(extra):
        """By a turn over all rows alike: the pixel's own row moves, too."""
        return own.pixels_of(own.project(state, points, direction, swing, extra, seat)[0])

    expected = differences(turned, 3, h)
    np.testing.assert_allclose(by_turn, expected, atol=near * np.abs(expected).max())
