# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from rs_localizer.core.state import step_between
from rs_localizer.estimation.prior import motion_terms
from rs_localizer.estimation.projection import squared_errors
from rs_localizer.estimation.robust import apply_step, inverted, refine, solve_positive

from .frames import changed, frame
from .projection import disturbed

NO_PRIOR = motion_terms((0.0, 0.0), (0.0, 0.0))


def test_a_step_turns_and_moves_the_camera_in_its_own_axes():
    _, state = frame(0, 0.15, 0.0, acceleration=0.1)
    step = np.array([0.1, -0.2, 0.3, 0.4, 0.5, -0.6, *np.linspace(0.01, 0.12, 12)])
    np.testing.assert_allclose(apply_step(state, step), disturbed(state, step), atol=1e-14)
    # A search's step leaves the accelerations as they are.
    step[12:] = 0.0
    np.testing.assert_allclose(apply_step(state, step[:12]), disturbed(state, step), atol=1e-14)


def test_the_truth_is_found_from_a_global_shutter_start():
    observations, truth = frame(0, 0.2, 0.0, count=40, acceleration=0.1)
    start = truth.copy()
    start[12:] = 0.0
    start = apply_step(start, 0.05 * np.random.default_rng(0).normal(size=18))
    state, _, cost, converged = refine(
        observations.packed, start, (1e3, 0.0), NO_PRIOR, 1e-3, 2, 30, 1e-6
    )
    assert converged
    assert cost < 1e-9
    assert np.abs(step_between(state, truth)).max() < 1e-7


def test_the_minimum_has_no_slope_of_the_posterior():
    """The gradient of cost plus prior vanishes, by finite differences of the cost itself."""
    observations, truth = frame(0, 0.1, 0.5, count=30)
    # Without the row's part the cost is exactly that of the residuals.
    data = changed(observations, gradient=np.zeros(2)).packed
    prior, noise, h = motion_terms((0.2, 0.1), (0.1, 0.05)), 0.5, 1e-6
    precisions = np.repeat([25.0, 100.0, 100.0, 400.0], 3)
    state = refine(data, truth, (1e3, 0.0), prior, noise, 2, 50, 1e-6)[0]

    def posterior(s):
        changes = s[12:]
        errors = squared_errors(data, observations.count, s)
        return errors.sum() + noise**2 * changes @ (precisions * changes)

    for e in np.eye(18):
        slope = (posterior(apply_step(state, h * e)) - posterior(apply_step(state, -h * e))) / (
            2 * h
        )
        curvature = (
            posterior(apply_step(state, 1e-4 * e)) + posterior(apply_step(state, -1e-4 * e))
            - 2 * posterior(state)
        ) / 1e-8  # fmt: skip
        assert abs(slope) < 1e-3 * np.sqrt(curvature) * noise


def test_a_matrix_that_is_not_positive_is_refused():
    for matrix in (np.zeros((2, 2)), np.ones((2, 2)), -np.eye(2), np.diag([1.0, np.nan])):
        assert not solve_positive(matrix, np.ones(2))[1]
        assert np.isnan(inverted(matrix)).all()


@pytest.mark.parametrize("size", [1, 12, 18, 54])
def test_the_inverse_is_numpy_s_also_where_parameters_are_held(size):
    rng = np.random.default_rng(size)
    factor = rng.normal(size=(size, 2 * size))
    matrix = factor @ factor.T
    np.testing.assert_allclose(inverted(matrix), np.linalg.inv(matrix), rtol=1e-8, atol=1e-12)
    held = np.arange(size) >= size // 2
    matrix[held, held] += 1e18
    free = np.linalg.inv(matrix[np.ix_(~held, ~held)])
    found = inverted(matrix)
    np.testing.assert_allclose(found[np.ix_(~held, ~held)], free, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(np.diag(found)[held], 1e-18, rtol=1e-9)
    np.testing.assert_array_equal(found, found.T)
