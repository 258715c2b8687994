# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What is not fitted: what it would explain, and what vibration that hides does to a motion.

A fit with scales takes the most probable ones, and where a frame hardly shows that it shakes these
are none at all. Here one factor of all scales is integrated over its hyperprior instead: given the
factor ``s``, all is linear and Gaussian about the best motion without vibration,

    log evidence = -log det(1 + s^2 N) / 2 - freedom / 2 log(1 - h^T (N + s^-2)^-1 h / freedom)

with the products ``N`` of the columns beside the motion and their slopes ``h``, both in variances
of the noise (Student's form, because the noise is of the same errors). Vibration of one frequency
at a time would hide less than that of all: a band looks like noise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.scales import SCALES
from rs_localizer.core.shake import CYCLES
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.state import MOTION_PARAMETERS, PARAMETERS
from rs_localizer.estimation.frame_fit import score_products
from rs_localizer.estimation.prior import PriorTerms
from rs_localizer.estimation.refine import inverted

# Where a hyperprior is sampled, in its deviations: three in a decade of scales.
_NODES = np.linspace(-2.25, 2.25, 7)
_WEIGHTS = np.exp(-0.5 * _NODES**2) / np.exp(-0.5 * _NODES**2).sum()
# Columns explain this part of the errors at most: the linear model holds no farther.
_MOST_EXPLAINED = 0.95


class Undetected(NamedTuple):
    """Vibration of the spectrum of an ordinary one."""

    log_evidence: float  # against none
    covariance: Array  # (12,12) by which it moves pose and velocities, if there is any


@kernel
def undetected_vibration(
    own: Array, pull: Array, along: Array, variance: float, freedom: float, mean: float,
    precision: float,
) -> Undetected:  # fmt: skip
    """Integrate over the size of vibration.

    Args:
        own: (k,k) products of columns beside the motion, each of size 1 in an ordinary vibration;
            px^2.
        pull: (k,18) by how much a coefficient moves the motion.
        along: (k,) slopes, px^2.
        variance: of the noise, px^2.
        freedom: of the errors.
        mean, precision: of the logarithm of the size, in ordinary ones.
    """
    size, moved, freedom = len(own), MOTION_PARAMETERS, max(freedom, 1.0)
    moments, total, most = np.zeros((moved, moved)), 0.0, -np.inf
    factor, right = np.empty((size, size)), np.empty((size, moved + 1))
    for node in range(len(_NODES)):
        scale = math.exp(2.0 * (mean + _NODES[node] / math.sqrt(precision)))
        part = scale / variance
        right[:, :moved], right[:, moved] = pull[:, :moved], along / variance
        # Cholesky's factor L of 1 + s^2 N, and L^-1 of the right-hand sides.
        for i in range(size):
            row, side = factor[i], right[i]
            for j in range(i + 1):
                row[j] = part * own[i, j]
            row[i] += 1.0
            for j in range(i):
                other, above = factor[j], right[j]
                rest = row[j]
                for k in range(j):
                    rest -= row[k] * other[k]
                row[j] = rest * other[j]
                row[i] -= row[j] * row[j]
                for k in range(moved + 1):
                    side[k] -= row[j] * above[k]
            row[i] = 1.0 / math.sqrt(max(row[i], 1.0))  # the inverse of its diagonal
            side *= row[i]
        explained = min(scale * np.sum(right[:, moved] ** 2) / freedom, _MOST_EXPLAINED)
        log_evidence = math.log(_WEIGHTS[node]) + np.sum(np.log(np.diag(factor)))
        log_evidence -= 0.5 * freedom * math.log1p(-explained)
        if log_evidence > most:
            moments *= math.exp(most - log_evidence)
            total *= math.exp(most - log_evidence)
            most = log_evidence
        probable = math.exp(log_evidence - most)
        total += probable
        spread = right.T @ right
        for i in range(moved):
            for j in range(moved):
                best = scale * spread[i, moved] * spread[j, moved]
                moments[i, j] += probable * scale * (spread[i, j] + best)
    return Undetected(most + math.log(total), moments / total)


@kernel
def score_statistics(
    data: Array, count: int, state: Array, inliers: BoolArray, prior: PriorTerms,
    noise: float, freedom: float, size: float, precision: float, turns: bool,
) -> tuple[Array, Array, float, Undetected]:  # fmt: skip
    """What each frequency of an in-frame turn, and a smooth error, would explain of the errors.

    Score statistics at the best motion without them, chi-squared where there is nothing (Rao 1948).

    Returns:
        (15,) of the 14 frequencies and the smooth error; their degrees of freedom (15,): 6, and 20
        or, where the motion mimics some of its columns, fewer; how much neighbouring rows agree;
        and what vibration may do, of ``size`` (logarithm) times the ordinary one, known to this
        ``precision``.
    """
    statistic, counts = np.zeros(SCALES), np.full(SCALES, 6.0)
    variance, frequencies = noise * noise, len(CYCLES)
    products, agreement = score_products(data, count, state, inliers, prior, variance, turns)
    own, crossed, along, within, across, beside, every, moving, pushed, inverse = products
    vibration = Undetected(-np.inf, np.zeros((MOTION_PARAMETERS, MOTION_PARAMETERS)))
    if turns:
        for f in range(frequencies):
            _beside_motion(own[f], crossed[f], inverse)
            statistic[f] = _explained(inverted(own[f]), along[f]) / variance
        pull, _ = _beside_motion(every, moving, inverse)
        vibration = undetected_vibration(every, pull, pushed, variance, freedom, size, precision)
    _, ridge = _beside_motion(within, across, inverse)
    left = inverted(within)
    statistic[frequencies] = _explained(left, beside) / variance
    counts[frequencies] = max(len(ridge) - np.sum(np.diag(left) * ridge), 1.0)
    return statistic, counts, agreement, vibration


@kernel
def _beside_motion(own: Array, crossed: Array, inverse: Array) -> tuple[Array, Array]:
    """Take the motion out of products of columns, ``N - X M^-1 X^T``; by how much they move it, and
    what stands on the diagonal so that columns that the motion mimics wholly explain nothing.
    """
    pulled, ridge = crossed @ inverse, 1e-6 * np.diag(own) + 1e-12
    for i in range(len(own)):
        own[i, i] += ridge[i]
        for j in range(i + 1):
            taken = 0.0
            for k in range(PARAMETERS):
                taken += pulled[i, k] * crossed[j, k]
            own[i, j] -= taken
            own[j, i] = own[i, j]
    return pulled, ridge


@kernel
def _explained(inverse: Array, along: Array) -> float:
    """Squares that columns explain beside the motion."""
    explained = float(np.sum(along * (inverse @ along)))
    return explained if np.isfinite(explained) else 0.0
