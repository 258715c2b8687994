# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors, derivatives and Gauss-Newton against a projection of the tests' own, row by row."""

from functools import partial

import numpy as np
import pytest

from rs_localizer.core.rig import Mounts
from rs_localizer.core.state import step_between
from rs_localizer.estimation import projection, robust
from rs_localizer.estimation.points import Observations
from rs_localizer.estimation.prior import motion_terms
from rs_localizer.estimation.projection import squared_errors
from rs_localizer.estimation.robust import apply_step
from rs_localizer.integrity import likeness

from . import projection as own
from .frames import alike, box, changed, differences, fitted, frame


@pytest.mark.parametrize("softness", [0.0, 1.0])
def test_robust_cost_and_its_slope_belong_together(softness):
    observations, state = frame(5, 0.15, 2.0, count=21, acceleration=0.2)
    data = changed(observations, gradient=np.zeros(2)).packed
    information, slope = np.empty((18, 18)), np.empty(18)

    def cost(step):
        there = apply_step(state, step)
        return projection.normal_equations(data, there, 3.0, softness, 2, information, slope)

    derivative = differences(cost, 18, 1e-6)
    cost(np.zeros(18))
    np.testing.assert_allclose(derivative, 2 * slope, rtol=1e-3, atol=1.0)


@pytest.mark.parametrize("softness", [0.0, 1.0])
def test_robust_costs_are_those_of_the_formulas(softness):
    # A search's cost is that of its one look, which knows no accelerations.
    observations, state = frame(5, 0.15, 2.0, count=21)
    data = changed(observations, gradient=np.zeros(2)).packed
    ratios = projection.squared_errors(data, len(observations), state) / 9.0
    assert (ratios > 1.0).any()
    assert (ratios < 1.0).any()
    truncated, tukey = np.minimum(ratios, 1.0), (1 - (1 - np.minimum(ratios, 1.0)) ** 3) / 3
    expected = 9.0 * (truncated if softness == 0.0 else tukey).sum()
    information, slope = np.empty((18, 18)), np.empty(18)
    found = projection.normal_equations(data, state, 3.0, softness, 2, information, slope)
    assert found == pytest.approx(expected)


def test_points_behind_the_camera_are_outliers_and_disturb_nothing():
    observations, state = frame(0, 0.15, 0.0, count=21)
    behind, axis = observations.points.copy(), state[6:9]
    behind[0] -= 2.0 * (axis @ behind[0] + state[11]) * axis
    data = changed(observations, behind).packed
    squared = projection.squared_errors(data, len(observations), state)
    assert np.isinf(squared[0])
    assert squared[1:].max() < 1e-6
    found = np.empty((2, 18, 18))
    for each, information in zip(
        (data, observations.only(np.arange(1, 21)).packed), found, strict=True
    ):
        projection.normal_equations(each, state, 3.0, 0.0, 2, information, np.empty(18))
    np.testing.assert_allclose(*found, rtol=1e-9, atol=1e-6)


def test_likeness_is_the_mean_over_nearest_neighbours():
    random = np.random.default_rng(0)
    points, numbers = random.normal(size=(90, 3)), random.normal(size=90)
    far = np.linalg.norm(points[:, None] - points, axis=2)
    nearest = np.argsort(far, axis=1)[:, 1:5]  # the first is the point itself
    expected = np.mean(numbers[:, None] * numbers[nearest])
    assert likeness(points, numbers, 4) == pytest.approx(expected, abs=1e-14)


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


NO_PRIOR = motion_terms((0.0, 0.0), (0.0, 0.0))


def test_the_truth_is_found_from_a_global_shutter_start():
    observations, truth = frame(0, 0.2, 0.0, count=40, acceleration=0.1)
    start = truth.copy()
    start[12:] = 0.0
    start = robust.apply_step(start, 0.05 * np.random.default_rng(0).normal(size=18))
    state, _, cost, converged = robust.refine(
        observations.packed, start, (1e3, 0.0), NO_PRIOR, 1e-3, 2, 30, 1e-6
    )
    assert converged
    assert cost < 1e-9
    assert np.abs(step_between(state, truth)).max() < 1e-7


def test_the_minimum_has_no_slope_of_the_posterior():
    observations, truth = frame(0, 0.1, 0.5, count=30)
    # Without the row's part the cost is exactly that of the residuals.
    data = changed(observations, gradient=np.zeros(2)).packed
    prior, noise = motion_terms((0.2, 0.1), (0.1, 0.05)), 0.5
    precisions = np.repeat([25.0, 100.0, 100.0, 400.0], 3)
    state = robust.refine(data, truth, (1e3, 0.0), prior, noise, 2, 50, 1e-6)[0]

    def posterior(step):
        there = robust.apply_step(state, step)
        errors = squared_errors(data, len(observations), there)
        return errors.sum() + noise**2 * there[12:] @ (precisions * there[12:])

    slope = differences(posterior, 18, 1e-6)
    near = [posterior(e) + posterior(-e) for e in 1e-4 * np.eye(18)]
    curvature = (np.array(near) - 2 * posterior(np.zeros(18))) / 1e-8
    assert np.all(np.abs(slope) < 1e-3 * np.sqrt(curvature) * noise)


def test_a_matrix_that_is_not_positive_is_refused():
    for matrix in (np.zeros((2, 2)), np.ones((2, 2)), -np.eye(2), np.diag([1.0, np.nan])):
        assert not robust.solve_positive(matrix, np.ones(2))[1]
        assert np.isnan(robust.inverted(matrix)).all()


@pytest.mark.parametrize("size", [1, 12, 18, 54])
def test_the_inverse_is_numpy_s_also_where_parameters_are_held(size):
    rng = np.random.default_rng(size)
    factor = rng.normal(size=(size, 2 * size))
    matrix = factor @ factor.T
    np.testing.assert_allclose(
        robust.inverted(matrix), np.linalg.inv(matrix), rtol=1e-8, atol=1e-12
    )
    held = np.arange(size) >= size // 2
    matrix[held, held] += 1e18
    free = np.linalg.inv(matrix[np.ix_(~held, ~held)])
    found = robust.inverted(matrix)
    np.testing.assert_allclose(found[np.ix_(~held, ~held)], free, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(np.diag(found)[held], 1e-18, rtol=1e-9)
    np.testing.assert_array_equal(found, found.T)


# Per readout of 0.03 s: the defaults.
PRIOR = motion_terms((0.18, 0.09), (0.009, 0.0036))


@pytest.mark.parametrize("gate", [2.6, 3.5, 8.0])
def test_noise_is_measured_whatever_the_gate_cuts_off(gate):
    errors = np.sum((1.3 * np.random.default_rng(0).normal(size=(200_000, 2))) ** 2, axis=1)
    assert robust.noise_deviation(errors, gate, 0.0) == pytest.approx(1.3, rel=0.03)


def test_noise_counts_the_degrees_of_freedom_and_never_divides_by_none():
    errors = np.full(10, 0.01)
    assert robust.noise_deviation(errors, 10.0, 10.0) == pytest.approx(np.sqrt(0.1 / 10), rel=1e-3)
    assert np.isfinite(robust.noise_deviation(errors, 10.0, 20.0))
    assert robust.noise_deviation(np.zeros(10), 1.0, 0.0) > 0.0
    # Points strewn evenly over the gate show no noise that fits into it.
    strewn = np.linspace(0.0, 4.0, 500)
    assert robust.noise_deviation(strewn, 2.0, 0.0) > 1.9


def test_the_noise_of_few_points_is_not_lowered_by_what_they_fit():
    squared, freedom = 0.0, 0.0
    for seed in range(60):
        observations, truth = frame(seed, 0.05, 0.5, count=20)
        posterior = fitted(observations, truth, PRIOR, 5.0)
        squared += posterior.squared_errors.sum()
        freedom += posterior.freedom
    assert squared / freedom == pytest.approx(0.25, rel=0.1)  # 2.6 % is one standard deviation
    assert freedom < 0.8 * 60 * 40
