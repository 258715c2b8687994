# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""In-frame turn as a Gaussian process, against dense matrices of plain NumPy."""

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import chi2

from rs_localizer.core.scales import FACTORS, SPECTRA, VIBRATIONS
from rs_localizer.core.shake import CYCLES, shake_at
from rs_localizer.core.state import step_between
from rs_localizer.estimation.correlated import nothing_shared
from rs_localizer.estimation.prior import add_prior
from rs_localizer.estimation.residuals import linearized
from rs_localizer.estimation.turn import fit_turn, hidden_turn

from .frames import PRIOR, frame

NONE = np.zeros(VIBRATIONS)


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
    gain, likelihoods, found = hidden_turn(
        lines, truth, chosen, nothing_shared(40), 0.0, PRIOR, noise, freedom, NONE
    )
    # What is remembered of frames before is not what this one says: it would count twice.
    calm = np.append(0.0, np.full(len(NONE) - 1, -9.0))
    calmer, again, _ = hidden_turn(
        lines, truth, chosen, nothing_shared(40), 0.0, PRIOR, noise, freedom, calm
    )
    assert calmer == pytest.approx(gain - 9.0)
    np.testing.assert_array_equal(again, likelihoods)
    assert gain == pytest.approx(logsumexp(logs), abs=0.05)
    weights = np.exp(logs - logsumexp(logs))
    expected = np.einsum("k,kij->ij", weights, moments)
    # Pose and velocities; what truncated combinations lose of accelerations is not asked for.
    deviations = np.sqrt(np.diag(expected))[:12]
    np.testing.assert_allclose(
        found[:12, :12] / np.outer(deviations, deviations),
        expected[:12, :12] / np.outer(deviations, deviations), atol=0.05,
    )  # fmt: skip


def shaken(seed, noise, degrees=0.3, cycles=1.3, count=80):
    rng = np.random.default_rng(1000 + seed)
    axis, phase = rng.normal(size=3), rng.uniform(0.0, 2.0 * np.pi)
    swing = np.radians(degrees) * axis / np.linalg.norm(axis)
    angle = 2.0 * np.pi * cycles

    def turn(tau):  # no turn and no rate in the middle, as the states have them
        wave = np.sin(angle * tau + phase) - np.sin(phase) - angle * tau * np.cos(phase)
        return np.outer(wave, swing)

    return frame(seed, 0.03, noise, count=count, swing=turn)


@pytest.mark.parametrize("noise", [0.1, 0.5])
def test_a_camera_that_shakes_is_followed_and_says_how_well(noise):
    inside, errors, plain = [], [], []
    for seed in range(8):
        observations, truth = shaken(seed, noise)
        fit = fit_turn(
            observations.packed, observations.count, truth, PRIOR, 2.0, 16.0, 2.0, NONE,
            np.zeros((80, 0)), np.log(0.03), np.log(0.03), 1.0, 590.0,
        )  # fmt: skip
        assert fit.finite
        assert fit.gain > (5.0 if noise < 0.2 else -1.0)
        error = step_between(fit.state, truth)[:6]
        inside.append(error @ np.linalg.solve(fit.covariance[:6, :6], error) < chi2.ppf(0.99, 6))
        errors.append(np.linalg.norm(error[:3]))
        swing = shake_at(observations.tau, fit.turns)[:, :3]
        plain.append(np.abs(swing).max())
    assert np.mean(inside) >= 0.8
    assert np.median(errors) < np.radians(0.03 if noise < 0.2 else 0.1)
    assert np.median(plain) > np.radians(0.2)
