# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What vibration that hides in the noise does to a motion: its evidence, and how far it moves it.

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

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.state import MOTION_PARAMETERS

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
