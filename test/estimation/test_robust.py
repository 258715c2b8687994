# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from rs_localizer.core.state import step_between
from rs_localizer.estimation import robust
from rs_localizer.estimation.prior import motion_terms
from rs_localizer.estimation.projection import squared_errors

from .frames import changed, differences, fitted, frame

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
