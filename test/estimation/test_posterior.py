# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from rs_localizer.estimation.prior import held_terms, motion_terms
from rs_localizer.estimation.robust import decided, inverted, noise_deviation

from .frames import fitted, frame

# Per readout of 0.03 s: the defaults.
PRIOR = motion_terms((0.18, 0.09), (0.009, 0.0036))


@pytest.mark.parametrize("gate", [2.6, 3.5, 8.0])
def test_noise_is_measured_whatever_the_gate_cuts_off(gate):
    errors = np.sum((1.3 * np.random.default_rng(0).normal(size=(200_000, 2))) ** 2, axis=1)
    assert noise_deviation(errors, gate, 0.0) == pytest.approx(1.3, rel=0.03)


def test_noise_counts_the_degrees_of_freedom_and_never_divides_by_none():
    errors = np.full(10, 0.01)
    assert noise_deviation(errors, 10.0, 10.0) == pytest.approx(np.sqrt(0.1 / 10), rel=1e-3)
    assert np.isfinite(noise_deviation(errors, 10.0, 20.0))
    assert noise_deviation(np.zeros(10), 1.0, 0.0) > 0.0
    # Points strewn evenly over the gate show no noise that fits into it.
    strewn = np.linspace(0.0, 4.0, 500)
    assert noise_deviation(strewn, 2.0, 0.0) > 1.9


def information(seed=0, points=1.0):
    factor = np.random.default_rng(seed).normal(size=(18, 40))
    return points * factor @ factor.T


def test_points_decide_what_the_prior_leaves_to_them(as_python):
    share_of = as_python(decided)
    noise, of_points = 0.5, information()
    nothing = motion_terms((0.0, 0.0), (0.0, 0.0))
    assert share_of(inverted(of_points), nothing, noise) == pytest.approx(18.0)
    held = of_points + noise**2 * held_terms().informations[0]
    assert share_of(inverted(held), held_terms(), noise) == pytest.approx(6.0)
    both = of_points + noise**2 * PRIOR.informations[0]
    # Trace of the gain: each direction counts by the share of it that is the points'.
    share = np.trace(np.linalg.solve(both, of_points))
    assert 6.0 < share < 18.0
    assert share_of(inverted(both), PRIOR, noise) == pytest.approx(share)
    weak = information(points=1e-9) + noise**2 * PRIOR.informations[0]
    assert share_of(inverted(weak), PRIOR, noise) == pytest.approx(6.0, abs=1e-3)


def test_the_noise_of_few_points_is_not_lowered_by_what_they_fit():
    """Squared errors per degree of freedom, over many frames, are the variance of the noise."""
    squared, freedom = 0.0, 0.0
    for seed in range(60):
        observations, truth = frame(seed, 0.05, 0.5, count=20)
        posterior = fitted(observations, truth, PRIOR, 5.0)
        squared += posterior.squared_errors.sum()
        freedom += posterior.freedom
    assert squared / freedom == pytest.approx(0.25, rel=0.1)  # 2.6 % is one standard deviation
    assert freedom < 0.8 * 60 * 40
