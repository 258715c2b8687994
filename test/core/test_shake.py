# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Cosines and sines of the in-frame turn, against their formulas."""

import numpy as np
import pytest

from rs_localizer.core.shake import (
    CYCLES,
    FUNCTIONS,
    MIDDLE_RATES,
    MIDDLE_VALUES,
    shake_at,
    shake_basis,
)

TAUS = [-0.5, -0.21, 0.0, 0.37, 0.5]


def basis(tau):
    values, rates = np.empty(FUNCTIONS), np.empty(FUNCTIONS)
    shake_basis(tau, values, rates)
    return values, rates


def plain(tau):
    """Values (28,) of one cosine and one sine per half-cycle, without value and slope at 0."""
    angle = 2.0 * np.pi * np.arange(0.5, 7.5, 0.5) * tau
    return np.column_stack([np.cos(angle) - 1.0, np.sin(angle) - angle]).ravel()


@pytest.mark.parametrize("tau", TAUS)
def test_values_are_those_of_cosines_and_sines(tau):
    np.testing.assert_allclose(basis(tau)[0], plain(tau), atol=1e-12)


@pytest.mark.parametrize("tau", TAUS)
def test_rates_are_derivatives_by_the_row_time(tau):
    h = 1e-5
    expected = (basis(tau + h)[0] - basis(tau - h)[0]) / (2.0 * h)
    np.testing.assert_allclose(basis(tau)[1], expected, atol=1e-5)


def test_what_is_taken_away_there_makes_it_whole_waves_again():
    values, slopes = MIDDLE_VALUES, MIDDLE_RATES
    for tau in TAUS:
        angle = 2.0 * np.pi * CYCLES * tau
        waves = np.column_stack([np.cos(angle), np.sin(angle)]).ravel()
        np.testing.assert_allclose(basis(tau)[0] + values + tau * slopes, waves, atol=1e-12)


def test_the_turn_of_many_rows_is_the_sum_of_all_functions():
    rng = np.random.default_rng(0)
    tau, coefficients = rng.uniform(-0.5, 0.5, 9), rng.normal(size=(FUNCTIONS, 3))
    found, h = shake_at(tau, coefficients), 1e-5
    ahead, here, behind = (
        np.array([plain(t + x) for t in tau]) @ coefficients for x in (h, 0.0, -h)
    )
    np.testing.assert_allclose(found[:, :3], here, atol=1e-11)
    np.testing.assert_allclose(found[:, 3:], (ahead - behind) / (2.0 * h), atol=1e-4)
    assert not shake_at(tau, np.zeros((0, 3))).any()
