# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The best motion of a frame: inliers by the noise, noise by the inliers."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, BoolArray, BoolArray1, Out
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.observations import weighted
from rs_localizer.estimation.prior import PriorTerms
from rs_localizer.estimation.refine import (
    EXPECTED_NOISE,
    LEAST_NOISE,
    inverted,
    refine,
    smallest_eigenvalue,
)
from rs_localizer.estimation.residuals import squared_errors
from rs_localizer.native import entry, inlined

# Inliers lie within this many standard deviations of the measured noise (99.8 % of Rayleigh
# distributed errors); the threshold is widened for them at most twofold.
GATE = 3.5
WIDEST_GATE = 2.0
_ROUNDS = 3
_ITERATIONS = 50
# Gain of a last step, noise variances: of the first round, whose inliers are not the last ones, and
# of the others.
_FIRST, _LATER = 1e-2, 1e-4
# A truncation that truncates nothing, px.
_NO_SCALE = 1e6
# Least eigenvalue of an information matrix scaled to a unit diagonal.
LEAST_EIGENVALUE = 1e-11
_NOISE_ROUNDS = 20


class Best(NamedTuple):
    """The best motion of a frame, and what the points say of it."""

    state: Array1  # (24,)
    covariance: Array2  # (18,18)
    noise: float  # px, measured standard deviation
    freedom: float  # of the errors
    smallest_eigenvalue: float  # of the information scaled to a unit diagonal, or less
    inliers: BoolArray1  # (n,)
    squared_errors: Array1  # (n,) px^2


class Posterior(NamedTuple):
    """The refined motion of one frame and what the points say of it."""

    state: Array  # (24,)
    covariance: Array  # (18,18), or more with the coefficients of the shaking
    noise: float  # px, measured standard deviation
    freedom: float  # of the errors
    smallest_eigenvalue: float  # of the information scaled to a unit diagonal, or less
    inliers: BoolArray  # (n,)
    squared_errors: Array  # (n,) px^2
    shake: Array = np.zeros((0, 3))  # (k,3) rad, coefficients
    model_error: float = 0.0  # px, root mean square of what the motion leaves beside the noise
    shared: float = 0.0  # px, likewise, of all modes together
    declared: float = 0.0  # px, the part of it that the map is known to be off
    speeding: float = 0.0  # squared velocities, in deviations of what the configuration expects
    # Probabilities of the typical speeds; empty: the configured one
    speeds: Array = np.zeros(0)
    near_outliers: int = 0  # points just beyond the gate, where they are too many to be chance
    # (18,18) with the second order of arcs, of a mixture; None: of the covariance as a Gaussian's
    arched: Array | None = None
    # (12,12) of pose and velocities, beside the covariance: vibration that hides in the noise
    undetected: Array = np.zeros((12, 12))
    # (s,f) logarithms of the evidence of each vibration, against none; empty: not looked at
    vibrations: Array = np.zeros((0, 0))
    # (n,b): of what the smooth error is a combination (see frame_fit), which other frames share, so
    # that the covariance does not have it, either
    bend: Array = np.zeros((0, 0))
    gate: float = 0.0  # px, of inliers, which goes on to twice as many for their noise

    @property
    def determined(self) -> bool:
        """True if points and prior together determine all parameters."""
        return self.smallest_eigenvalue > LEAST_EIGENVALUE

    @property
    def inflation(self) -> float:
        """Inflation of the variances, because the noise itself is an estimate.

        Squared distances follow an F distribution; this makes its 95 % quantile that of the
        chi-squared one, to half a percent from 40 degrees of freedom.
        """
        left = max(self.freedom, 6.0)
        return left / (left - 5.0)


@entry
def noise_deviation(squared_errors: Array1, gate: float, freedom: float) -> float:
    """Return the standard deviation of the pixel noise from the errors within a gate.

    Args:
        squared_errors: (n,) of all points.
        gate: px.
        freedom: degrees of freedom that the fit has used up.

    The errors of true inliers are Rayleigh distributed; cutting them off at the gate lowers their
    mean square by a factor that depends on the deviation itself, hence the fixed point.
    """
    total, left = 0.0, -freedom
    for squared in squared_errors:
        if squared < gate * gate:
            total += squared
            left += 2.0
    if left <= 0.0:
        return gate / GATE
    mean = total / left
    variance = mean
    for _ in range(_NOISE_ROUNDS):
        u = gate * gate / (2.0 * max(variance, 1e-12 * gate * gate))
        kept = 1.0 - u * math.exp(-u) / -math.expm1(-u)
        variance = min(mean / max(kept, 1e-3), gate * gate)
    return max(math.sqrt(variance), LEAST_NOISE)


@inlined
def decided(inverse: Array2, prior: PriorTerms, noise: float) -> float:
    """Count the parameters that the points decide, and not the prior.

    Args:
        inverse: (18,18) of the information of both, px^-2.
        noise: px, the one that the prior was weighed against.
    """
    size = len(inverse)
    total = float(size)
    for term in range(len(prior.informations)):
        for i in range(size):
            for j in range(size):
                total -= noise * noise * inverse[i, j] * prior.informations[term, i, j]
    return max(total, 0.0)


@inlined
def _least_eigenvalue(information: Array, inverse: Array) -> float:
    """Return the least eigenvalue, or a bound if it is large, for a unit diagonal."""
    total = 0.0  # of the eigenvalues of the scaled inverse
    for i in range(len(information)):
        total += inverse[i, i] * information[i, i]
    if total > 0.0 and total < 1.0 / LEAST_EIGENVALUE:
        return 1.0 / total
    return smallest_eigenvalue(information)


@entry
def best_motion(
    data: Out[Array2], count: int, start: Array1, prior: PriorTerms, threshold: float
) -> Best:
    """Refine a motion, measure the noise, choose the inliers, and again.

    Args:
        data: packed points, ``count`` of them.
        start: state (24,).
        threshold: px, least gate for inliers.
    """
    # The gate closes from the wide side: a start that fits few points well would see little noise
    # and keep few.
    state, gate, noise, freedom = start, WIDEST_GATE * threshold, EXPECTED_NOISE * threshold, 0.0
    errors = squared_errors(data, count, state)
    weights = np.empty(count)
    information = np.empty((PARAMETERS, PARAMETERS))
    inverse = information
    for turn in range(_ROUNDS):
        for i in range(count):
            weights[i] = 1.0 if errors[i] < gate * gate else 0.0
        state, information, _, _ = refine(
            weighted(data, weights), state, _NO_SCALE, 0.0, prior, noise, 2, _ITERATIONS,
            _FIRST if turn == 0 else _LATER,
        )  # fmt: skip
        errors = squared_errors(data, count, state)
        inverse = inverted(information)
        # The prior takes its part of the parameters that the points decide.
        freedom = decided(inverse, prior, noise)
        noise = noise_deviation(errors, gate, freedom)
        gate = min(max(threshold, GATE * noise), WIDEST_GATE * threshold)
    inliers = errors < gate * gate
    return Best(
        state, noise * noise * inverse, noise, 2.0 * np.sum(inliers) - freedom,
        _least_eigenvalue(information, inverse), inliers, errors,
    )  # fmt: skip
