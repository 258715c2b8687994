# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors and derivatives against the forward projection, which solves for each point's row."""

import numpy as np
import pytest

from rs_localizer.estimation import projection
from rs_localizer.estimation.robust import apply_step
from rs_localizer.integrity import likeness

from .frames import changed, differences, frame


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
