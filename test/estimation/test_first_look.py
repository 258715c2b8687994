# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What is not fitted: score statistics, and vibration that hides, against dense Gaussians."""

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.frames.conditions import HAND, Condition, moving
from benchmarks.frames.judged import judge
from benchmarks.independent.scenes import Rich
from rs_localizer.core.shake import COMBINATIONS, CYCLES
from rs_localizer.estimation.first_look import (
    near_outliers,
    score_products,
    score_statistics,
    undetected_vibration,
)
from rs_localizer.estimation.frame_fit import products_of
from rs_localizer.estimation.posterior import maximum_a_posteriori
from rs_localizer.estimation.residuals import linearized

from .frames import PRIOR, frame

COLUMNS, NOISE, FREEDOM = 9, 0.5, 1e7  # so many that the noise is known


@pytest.mark.parametrize("size", [0.0, 3e-3])
def test_evidence_and_covariance_are_those_of_dense_gaussians(size):
    rng = np.random.default_rng(3)
    columns = 600.0 * rng.normal(size=(80, COLUMNS)) / np.sqrt(80)
    errors = NOISE * rng.normal(size=80) + size * columns @ rng.normal(size=COLUMNS)
    pull, mean, precision = rng.normal(size=(COLUMNS, 18)), np.log(5e-4), 0.7
    found = undetected_vibration(
        columns.T @ columns, pull, columns.T @ errors, NOISE**2, FREEDOM, mean, precision
    )
    # Twenty times as many nodes, and covariances of all errors instead of those of coefficients.
    nodes = np.linspace(-3.0, 3.0, 141)
    weights = np.exp(-0.5 * nodes**2)
    weights /= weights.sum()
    total, moments = 0.0, np.zeros((12, 12))
    for weight, scale in zip(weights, np.exp(mean + nodes / precision**0.5), strict=True):
        spread = NOISE**2 * np.eye(80) + scale**2 * columns @ columns.T
        gain = scale**2 * columns.T @ np.linalg.inv(spread)
        likelihood = weight * np.exp(
            -0.5 * np.linalg.slogdet(spread / NOISE**2)[1]
            - 0.5 * errors @ np.linalg.solve(spread, errors)
            + 0.5 * errors @ errors / NOISE**2
        )
        best = gain @ errors
        second = scale**2 * (np.eye(COLUMNS) - gain @ columns) + np.outer(best, best)
        total += likelihood
        moments += likelihood * (pull.T @ second @ pull)[:12, :12]
    assert found.log_evidence == pytest.approx(np.log(total), abs=0.4)
    assert (found.log_evidence > 5.0) == (size > 0.0)
    ratios = np.sqrt(np.diag(found.covariance) / np.diag(moments / total))
    np.testing.assert_allclose(ratios, 1.0, atol=0.12)


def scored(motion, noise):
    """Squared normalised errors of pose at the first row and of the twist, 60 frames."""
    condition = Condition("own", "", motion, Rich(), noise)
    found = judge(condition, 60, 4, {})
    return found, np.array([found.of("pose_s"), found.of("twist")]).T


def test_regions_hold_for_vibration_that_no_frame_shows():
    """A tenth of a degree at 20 Hz, which the rows hardly tell from a steady turn."""
    _, squared = scored(moving("vibration", degrees=0.1, hertz=20.0), 0.3)
    # Without, 68 % of the twists (benchmarks.frames, sine/0.1deg/20Hz/0.3px, seed 1).
    inside = np.mean(squared < chi2.ppf(0.95, 6), axis=0)
    assert (inside >= 0.85).all(), inside


def test_a_calm_hand_is_not_said_to_shake():
    found, squared = scored(HAND, 0.3)
    assert (np.mean(squared < chi2.ppf(0.95, 6), axis=0) >= 0.93).all()
    # Claimed over actual deviation of the turn rate, three dimensions.
    assert np.sqrt(chi2.median(3) / np.median(found.of("angular"))) < 1.7


def test_scores_are_of_the_columns_of_a_fit():
    """Of the combinations that the rows resolve exactly; of a frequency but for what they leave."""
    observations, state = frame(0, 0.02, 0.5, 60)
    best = maximum_a_posteriori(observations, state, PRIOR, 2.0)
    packed, count = observations.packed, observations.count
    lines = linearized(packed, count, best.state, np.zeros((count, 6)))
    whole = products_of(lines, best.inliers, lines.errors, True, False, np.zeros((0, 0)))
    found, _ = score_products(packed, count, best.state, best.inliers, PRIOR, 0.25, True)
    turns, motion = whole.products[18:, 18:], whole.products[18:, :18]
    combined = np.kron(COMBINATIONS, np.eye(3))
    size = np.sqrt(np.outer(*2 * [np.diag(combined.T @ turns @ combined)]))
    np.testing.assert_allclose(
        found.together / size, combined.T @ turns @ combined / size, atol=1e-9
    )
    np.testing.assert_allclose(found.together_by_motion, combined.T @ motion, rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(
        found.together_along, combined.T @ whole.with_errors[18:], rtol=1e-7, atol=1e-6
    )
    for f in range(len(CYCLES)):
        one = slice(6 * f, 6 * f + 6)
        size = np.sqrt(np.diag(turns[one, one]))
        difference = (found.own[f] - turns[one, one]) / np.outer(size, size)
        assert np.abs(difference).max() < 3e-2, f
        away = (found.along[f] - whole.with_errors[18:][one]) / (size * best.noise)
        assert np.abs(away).max() < 0.1, f


@pytest.mark.bench
def test_scores_are_chi_squared_where_there_is_nothing():
    """Mean 6 of each frequency, and 14 of a smooth error: the motion mimics six of its twenty."""
    statistics = []
    for seed in range(200):
        observations, state = frame(seed, 0.02, 0.5, 60)
        best = maximum_a_posteriori(observations, state, PRIOR, 2.0)
        statistic, *_ = score_statistics(
            observations.packed, len(observations), best.state,
            best.inliers, PRIOR, 0.5, best.freedom, 0.0, 1.0, True,
        )  # fmt: skip
        statistics.append(statistic)
    mean = np.mean(statistics, axis=0)
    # Sampling errors: sqrt(2 x 6 / 200) = 0.24, and 0.45. What half a cycle and a whole one look
    # like is an acceleration, for which the prior has room that these frames do not use.
    np.testing.assert_allclose(mean[2:-1], 6.0, atol=1.0)
    assert np.all((mean[:2] > 3.5) & (mean[:2] < 6.5))
    assert mean[-1] == pytest.approx(14.0, abs=1.8)


@pytest.mark.parametrize(
    ("inliers", "near", "told"),
    [(12, 3, 3), (13, 2, 0), (16, 4, 0), (20, 4, 0), (20, 5, 5), (40, 7, 0), (40, 8, 8)],
)
def test_points_just_beyond_the_gate_are_told_unless_they_are_one_marker(inliers, near, told):
    """Distances of 3 and 12 px around a gate of 4 px, and of wrong points at 100."""
    squared = np.square(np.repeat([3.0, 12.0, 100.0], [inliers, near, 6]))
    assert near_outliers(squared, squared < 16.0, 2.0) == told
