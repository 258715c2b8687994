# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Correlated noise in closed form, against dense matrices of plain NumPy."""

import numpy as np
import pytest
from scipy.special import logsumexp

from rs_localizer.estimation.correlated import (
    Noise,
    bend_of,
    over_sizes,
    products_at,
    smooth_columns,
    smooth_error,
    volume_of,
)
from rs_localizer.estimation.prior import add_prior, terms_at
from rs_localizer.estimation.residuals import linearized

from .frames import PRIOR, frame

NOISE = 0.4
SIZES = np.linspace(-2.5, 5.5, 11)  # as the module has them
TERMS = terms_at(PRIOR, 0.1, False)


def everything(bent, as_python):
    observations, truth = frame(3, 0.05, NOISE, count=30)
    chosen = np.ones(30, bool)
    chosen[[4, 17]] = False
    lines = linearized(observations.packed, 30, truth, np.zeros((30, 6)))
    bend = np.zeros((30, 0))
    if bent:
        bend = bend_of(observations.points, chosen, 4.0 / 590.0)
    smooth = smooth_error(lines, chosen, bend, np.log(0.2))
    columns = smooth_columns(lines.by_motion[chosen], lines.image[chosen], bend[chosen])
    return observations, truth, chosen, lines, smooth, columns.reshape(56, -1)


@pytest.mark.parametrize("bent", [False, True])
def test_sizes_are_integrated_as_over_dense_matrices(as_python, bent):
    observations, truth, chosen, lines, smooth, columns = everything(bent, as_python)
    products = as_python(products_at)(observations.packed, 30, truth, chosen, smooth.rows)
    information, slope = np.zeros((18, 18)), np.zeros(18)
    prior_cost = add_prior(TERMS, truth, 1.0, information, slope)
    # One noise for all sizes: it is held, but for rounding.
    noise = Noise(NOISE, 1.0, 12.0)
    volume = as_python(volume_of)(TERMS)
    found = as_python(over_sizes)(products, smooth, information, slope, prior_cost, volume, noise)
    dense, errors = lines.by_motion[chosen].reshape(56, 18), lines.errors[chosen].ravel()
    if not bent:
        np.testing.assert_allclose(
            (smooth.rows * smooth.squares) @ smooth.rows.T, columns @ columns.T, atol=2e-3
        )
    logs, steps, covariances = [], [], []
    for away in SIZES:
        shared = 0.2**2 * np.exp(2.0 * away) * columns @ columns.T

        def at(deviation, shared=shared):
            whole = shared + deviation**2 * np.eye(56)
            inverse = np.linalg.inv(whole)
            of_step = dense.T @ inverse @ dense + information
            step = -np.linalg.solve(of_step, dense.T @ inverse @ errors + slope)
            moved = errors + dense @ step
            rest = deviation**2 * inverse @ moved
            own = np.linalg.inv(of_step)
            cost = errors @ inverse @ errors + prior_cost
            cost += step @ (dense.T @ inverse @ errors + slope)
            log = -0.5 * (
                cost + np.linalg.slogdet(2.0 * np.pi * whole)[1] + np.linalg.slogdet(of_step)[1]
            )
            taken = 56.0 - deviation**2 * np.trace(inverse)
            left = rest @ rest / max(56.0 - 12.0 - taken, 5.6)
            usual = NOISE * np.array([0.16, 1.3])
            return log, step, own, np.clip(np.sqrt(left), *usual)

        if not logs:
            deviation_here = at(NOISE)[3]
        log, step, covariance, deviation_here = at(deviation_here)
        logs.append(log - 0.5 * away**2)
        steps.append(step)
        covariances.append(covariance)
    weights = np.exp(np.array(logs) - logsumexp(logs))
    mean = weights @ np.array(steps)
    spread = np.einsum("k,kij->ij", weights, covariances)
    spread += np.einsum("k,ki,kj->ij", weights, steps - mean, steps - mean)
    deviations = np.sqrt(np.diag(spread))
    np.testing.assert_allclose(found.step / deviations, mean / deviations, atol=0.02)
    scaled = found.covariance / np.outer(deviations, deviations)
    np.testing.assert_allclose(scaled, spread / np.outer(deviations, deviations), atol=0.02)
    expected = logsumexp(logs) - logsumexp(-0.5 * SIZES**2) + volume
    assert found.evidence == pytest.approx(expected, abs=0.05)
    sizes = 0.2 * np.exp(SIZES)
    assert found.size == pytest.approx(np.sqrt(weights @ sizes**2), rel=0.05)
