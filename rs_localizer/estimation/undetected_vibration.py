# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What vibration that hides in the noise does to a motion: its evidence, and how far it moves it.

A fit with scales takes the most probable ones, and where a frame hardly shows that it shakes these
are none at all. Here the scale of one frequency at a time is integrated over its hyperprior
instead: given the scale ``s``, all is linear and Gaussian about the best motion without vibration,

    log evidence = -log det(1 + s^2 N) / 2 - freedom / 2 log(1 - h^T (N + s^-2)^-1 h / freedom)

with the products ``N`` of the columns beside the motion and their slopes ``h``, both in variances
of the noise (Student's form, because the noise is of the same errors).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.state import MOTION_PARAMETERS
from rs_localizer.estimation.refine import half_inverse

# Where a hyperprior is sampled, in its deviations: three in a decade of scales.
_NODES = np.linspace(-2.25, 2.25, 7)
_WEIGHTS = np.exp(-0.5 * _NODES**2) / np.exp(-0.5 * _NODES**2).sum()
# Columns explain this part of the errors at most: the linear model holds no farther.
_MOST_EXPLAINED = 0.95
_TINY = 1e-300


class Undetected(NamedTuple):
    """Vibration of any one frequency."""

    log_evidence: float  # against none
    covariance: Array  # (12,12) by which it moves pose and velocities, if there is any


@inlined
def _product(left: Array, right: Array, first: int, end: int) -> float:
    total = 0.0
    for k in range(first, end):
        total += left[k] * right[k]
    return total


@kernel
def undetected_vibration(
    own: Array, pull: Array, along: Array, variance: float, freedom: float, means: Array,
    precisions: Array,
) -> Undetected:  # fmt: skip
    """Integrate over the scales of k frequencies, one at a time.

    Args:
        own: (k,6,6) products of a frequency's columns beside the motion, px^2.
        pull: (k,6,18) by how much a coefficient moves the motion.
        along: (k,6) slopes, px^2.
        variance: of the noise, px^2.
        freedom: of the errors.
        means, precisions: (k,) of the logarithms of the scales.
    """
    count, size, freedom = pull.shape[0], pull.shape[1], max(freedom, 1.0)
    moments, total, most = np.zeros((count, size, size)), 0.0, 0.0
    matrix, whitened, best = np.empty((size, size)), np.empty(size), np.empty(size)
    for f in range(count):
        for node in range(len(_NODES)):
            scale = math.exp(2.0 * (means[f] + _NODES[node] / math.sqrt(precisions[f])))
            part = scale / variance
            for i in range(size):
                for j in range(size):
                    matrix[i, j] = part * own[f, i, j]
                matrix[i, i] += 1.0
            half, unit, positive = half_inverse(matrix)
            if not positive:
                continue
            explained, volume = 0.0, 0.0
            for i in range(size):
                for j in range(i + 1):
                    half[i, j] *= unit[j]
                whitened[i] = _product(half[i], along[f], 0, i + 1) / variance
            for i in range(size):
                volume += math.log(half[i, i])
                explained += scale * whitened[i] * whitened[i]
            log_evidence = math.log(_WEIGHTS[node] / count) + volume
            explained = min(explained / freedom, _MOST_EXPLAINED)
            log_evidence -= 0.5 * freedom * math.log1p(-explained)
            if log_evidence > most:
                moments *= math.exp(most - log_evidence)
                total *= math.exp(most - log_evidence)
                most = log_evidence
            probable = math.exp(log_evidence - most)
            total += probable
            for i in range(size):
                best[i] = scale * _product(half[:, i], whitened, i, size)
            for i in range(size):
                for j in range(size):
                    spread = scale * _product(half[:, i], half[:, j], max(i, j), size)
                    moments[f, i, j] += probable * (spread + best[i] * best[j])
    covariance = np.zeros((MOTION_PARAMETERS, MOTION_PARAMETERS))
    for f in range(count):
        moved = pull[f].T @ moments[f] @ pull[f]
        covariance += moved[:MOTION_PARAMETERS, :MOTION_PARAMETERS] / max(total, _TINY)
    return Undetected(most + math.log(max(total, _TINY)), covariance)
