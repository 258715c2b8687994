# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""In-frame turn as a Gaussian process, against dense matrices of plain NumPy."""

import numpy as np
import pytest
from scipy.special import logsumexp

from rs_localizer.core.shake import CYCLES
from rs_localizer.estimation.correlated import nothing_shared
from rs_localizer.estimation.prior import add_prior
from rs_localizer.estimation.residuals import linearized
from rs_localizer.estimation.turn import FACTORS, SPECTRA, hidden_turn

from .frames import PRIOR, frame


def test_all_spectra_are_as_strong():
    strengths = np.square(SPECTRA).sum(axis=1)
    np.testing.assert_allclose(strengths, strengths[0])


def test_hidden_vibration_is_integrated_as_over_dense_matrices():
    """Whole cosines and sines beside a motion of which a prior knows something, at one noise."""
    observations, truth = frame(5, 0.05, 0.5, count=40)
    chosen = np.ones(40, bool)
    lines = linearized(observations.packed, 40, truth, np.zeros((40, 6)))
    information, slope = np.zeros((18, 18)), np.zeros(18)
    prior_cost = add_prior(PRIOR, truth, 1.0, information, slope)
    dense, errors = lines.by_motion.reshape(80, 18), lines.errors.ravel()
    angles = 2.0 * np.pi * np.outer(lines.tau, CYCLES)
    waves = np.stack([np.cos(angles) - 1.0, np.sin(angles) - angles], 2).reshape(40, -1)
    middle = np.zeros((18, 28, 3))
    for axis in range(3):
        middle[axis, ::2, axis] = 1.0
        middle[6 + axis, 1::2, axis] = 2.0 * np.pi * CYCLES
    turns = (lines.by_turn[:, :, None, :] * waves[:, None, :, None]).reshape(80, -1)
    turns = turns + dense @ middle.reshape(18, -1)
    logs, moments = [], []
    freedom, noise = 62.0, 0.5
    white = dense.T @ dense / noise**2 + information
    first = -np.linalg.solve(white, dense.T @ errors / noise**2 + slope)
    sizes = np.repeat(SPECTRA[0], 2)
    prior = -0.5 * (np.log(FACTORS) / np.log(10.0)) ** 2
    prior -= logsumexp(prior) + np.log(len(SPECTRA))
    rest = noise**2 * (
        errors @ errors / noise**2 + prior_cost
        + first @ (dense.T @ errors / noise**2 + slope)
    )  # fmt: skip
    for factor, before in zip(FACTORS, prior, strict=True):
        columns = turns * np.repeat(factor * sizes, 3)
        beside = columns.T @ columns / noise**2
        across = np.linalg.solve(white, dense.T @ columns) / noise**2
        beside -= columns.T @ dense / noise**2 @ across
        along = columns.T @ (errors + dense @ first) / noise**2
        inner = np.linalg.inv(np.eye(84) + beside)
        explained = noise**2 * along @ inner @ along
        left = 1.0 - explained / rest
        logs.append(before + 0.5 * np.linalg.slogdet(inner)[1] - 0.5 * freedom * np.log(left))
        pull = middle.reshape(18, -1) * np.repeat(factor * sizes, 3) - across
        mean = -inner @ along
        second = rest * left / freedom / noise**2 * inner + np.outer(mean, mean)
        moments.append(pull @ second @ pull.T)
    gain, found = hidden_turn(lines, truth, chosen, nothing_shared(40), 0.0, PRIOR, noise, freedom)
    assert gain == pytest.approx(logsumexp(logs), abs=0.05)
    weights = np.exp(logs - logsumexp(logs))
    expected = np.einsum("k,kij->ij", weights, moments)
    # Pose and velocities; what truncated combinations lose of accelerations is not asked for.
    deviations = np.sqrt(np.diag(expected))[:12]
    np.testing.assert_allclose(
        found[:12, :12] / np.outer(deviations, deviations),
        expected[:12, :12] / np.outer(deviations, deviations), atol=0.05,
    )  # fmt: skip
