# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The best motion of a frame (Levenberg-Marquardt with a prior), and which points are outliers.

Parameters of a step, as in ``Estimate.covariance``: the camera turns by ``exp([phi]x)`` in its own
axes, moves by ``rho`` along them, and velocities and accelerations change additively.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, BoolArray1, Out
from rs_localizer.core.so3 import exp
from rs_localizer.core.state import MOTION_PARAMETERS, PARAMETERS
from rs_localizer.estimation.points import weighted
from rs_localizer.estimation.prior import PriorTerms, add_prior
from rs_localizer.estimation.projection import normal_equations, squared_errors
from rs_localizer.native import entry, inlined, kernel

EXPECTED_NOISE = 0.5
"""Standard deviation of the noise before it is measured, in inlier thresholds."""

LEAST_NOISE = 0.01
"""Standard deviation (px) that noise is never below, as no camera's is: rounding is no measure."""

# Damping, as a part of the diagonal, and how it changes (Nielsen, Damping parameter in Marquardt's
# method, 1999).
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-8, 1e8
_GROWTH, _LEAST_KEPT = 2.0, 1.0 / 3.0
TINY = 1e-300
"""What is divided by where nothing is."""
# Pivots below this part of what they are made of are rounding errors.
_SINGULAR = 1e-15
# Unknowns that are eliminated together: 54 take 7.0 us, and 8.5 by two at a time.
_TOGETHER = 4
# More damping halts in the flat valleys of fast planes; less damping loses planes that face the
# camera.
_ANNEALING_DAMPING, _ANNEALING_RATIO = 1e-4, 0.6


@entry
def apply_step(state: Array1, step: Array1) -> Array:
    """Move a state by a step (18,), or (12,) that leaves the accelerations."""
    turn = exp(-step[0:3])
    moved, from_step = state.copy(), state.copy()
    for k in range(3, len(step)):
        from_step[k + 6] += -step[k] if k < 6 else step[k]
    for i in range(3):
        for j in range(4):  # the columns of the rotation, and the translation
            at = 3 * i + j if j < 3 else 9 + i
            moved[at] = 0.0
            for k in range(3):
                moved[at] += turn[i, k] * from_step[3 * k + j if j < 3 else 9 + k]
    moved[12:] = from_step[12:]
    return moved


@kernel
def _scaled(row: Array, least: float) -> bool:
    """Divide a row by the root of its pivot; return whether that is more than the least one."""
    positive: bool = row[0] > least
    scale = 1.0 / math.sqrt(max(row[0], least))
    for j in range(len(row)):
        row[j] *= scale
    return positive


@kernel
def _take(row: Array, other: Array, part: float) -> None:
    for j in range(len(row)):
        row[j] -= part * other[j]


@kernel
def eliminate(equations: Array, count: int) -> bool:
    """Take ``count`` unknowns out of symmetric equations, of which the upper triangle counts.

    With ``[A h]`` in their rows these become ``[R z]``: ``R^T R = A`` and ``R^T z = h`` (Cholesky).
    The rows below become those of the other unknowns alone (Schur's complement).

    Returns whether ``A`` is positive definite; what falls below rounding is raised to it. Takes a
    third of the time of ``np.linalg.cholesky``, which would raise.
    """
    size, positive, least = len(equations), True, np.empty(count)
    for k in range(count):
        least[k] = max(_SINGULAR * equations[k, k], TINY)
    for first in range(0, count, _TOGETHER):  # rows below are read and written once for all
        last = min(first + _TOGETHER, count)
        for k in range(first, last):
            for above in range(first, k):
                _take(equations[k, k:], equations[above, k:], equations[above, k])
            positive = _scaled(equations[k, k:], least[k]) and positive
        for i in range(last, size):
            if last - first < _TOGETHER:
                for k in range(first, last):
                    _take(equations[i, i:], equations[k, i:], equations[k, i])
                continue
            # Loops over slices from zero are what the compiler makes vectors of.
            other, one, two = equations[i, i:], equations[first, i:], equations[first + 1, i:]
            three, four = equations[first + 2, i:], equations[first + 3, i:]
            a, b, c, d = one[0], two[0], three[0], four[0]
            for j in range(len(other)):
                other[j] -= (a * one[j] + b * two[j]) + (c * three[j] + d * four[j])
    return positive


@kernel
def back(factor: Array2, solution: Array1) -> None:
    """Fill in the solution (n,) of ``A x = h``, by ``[R z]`` (n,n+1)."""
    size = len(factor)
    for i in range(size):
        solution[i] = factor[i, size]
    for i in range(size - 1, -1, -1):
        part = solution[i] / factor[i, i]
        solution[i] = part
        for k in range(i):
            solution[k] -= part * factor[k, i]


@kernel
def half_of(factor: Array2) -> Array:
    """Return the lower triangle ``H`` with ``H^T H`` the inverse of ``R^T R``.

    Takes a fifth of the time of ``np.linalg.inv``.
    """
    size = len(factor)
    half = np.zeros((size, size))
    for i in range(size):
        row, inverse = half[i], 1.0 / factor[i, i]
        for k in range(i):  # along the rows, for the sake of the caches
            above, part = half[k], factor[k, i] * inverse
            for j in range(k + 1):
                row[j] -= part * above[j]
        row[i] = inverse
    return half


@entry
def solve_positive(matrix: Array2, right: Array1) -> tuple[Array, bool]:
    """Solve a symmetric positive definite system; return whether it is one."""
    size = len(right)
    equations, solution = np.empty((size, size + 1)), np.empty(size)
    equations[:, :size], equations[:, size] = matrix, right
    positive = eliminate(equations, size)
    back(equations, solution)
    return solution, positive


@entry
def inverted(matrix: Array2) -> Array:
    """Return the inverse of a symmetric positive definite matrix; NaN if it is none."""
    return inverse_of(matrix)[0]


@entry
def inverse_of(matrix: Array2) -> tuple[Array, float]:
    """Return the inverse, and half the logarithm of the determinant; NaN as of `inverted`."""
    factor, volume = matrix.copy(), 0.0
    if not eliminate(factor, len(factor)):
        return np.full(matrix.shape, np.nan), np.nan
    for k in range(len(factor)):
        volume += math.log(factor[k, k])
    half = half_of(factor)
    return half.T @ half, volume


@kernel
def _posterior(
    data: Array, state: Array, loss: tuple[float, float], prior: PriorTerms, noise: float,
    looks: int, information: Array, slope: Array,
) -> float:  # fmt: skip
    """Return normal equations and cost with the prior, in squared pixels."""
    cost = normal_equations(data, state, loss[0], loss[1], looks, information, slope)
    return cost + add_prior(prior, state, noise * noise, information, slope)


@entry
def refine(
    data: Array2, start: Array1, loss: tuple[float, float], prior: PriorTerms, noise: float,
    looks: int, iterations: int, tolerance: float,
) -> tuple[Array, Array, float, bool]:  # fmt: skip
    """Minimize the robust cost of all points plus the prior.

    Args:
        data: packed points, with weights.
        start: state (24,).
        loss: scale (px) and softness, see :mod:`rs_localizer.estimation.projection`.
        prior: see :mod:`rs_localizer.estimation.prior`.
        noise: standard deviation of the pixels, against which the prior is weighed.
        looks: at each point's row, 1 or 2 (see :class:`rs_localizer.estimation.projection.View`);
            1 holds the accelerations.
        iterations: most steps.
        tolerance: a step that gains less than this, in noise variances, is the last one, and
            the information that of the state before it.

    Returns:
        state (24,), information (18,18) or (12,12) times the noise variance, cost, and whether a
        step was accepted as the last one or nothing more was to be gained.
    """
    state = start.copy()
    size = MOTION_PARAMETERS if looks == 1 else PARAMETERS
    information = np.empty((size, size))
    slope = np.empty(size)
    next_information = np.empty((size, size))
    next_slope = np.empty(size)
    cost = _posterior(data, state, loss, prior, noise, looks, information, slope)
    damping, growth = 0.0, _GROWTH
    converged = False
    for _ in range(iterations):
        damped = information.copy()
        for i in range(size):
            damped[i, i] *= 1.0 + damping
        step, solved = solve_positive(damped, -slope)
        accepted = False
        if solved:
            gain, predicted = 0.0, 0.0
            for i in range(size):
                gain -= step[i] * slope[i]
                predicted += damping * information[i, i] * step[i] * step[i]
            trial = apply_step(state, step)
            converged = gain < tolerance * noise * noise
            if converged and damping == 0.0:
                # So near the optimum an evaluation at the new state would change nothing.
                return trial, information, cost - gain, True
            trial_cost = _posterior(
                data, trial, loss, prior, noise, looks, next_information, next_slope
            )
            accepted = trial_cost <= cost
            if accepted:
                # If the gain is the predicted one, the next step may be longer.
                held = 2.0 * (cost - trial_cost) / max(gain + predicted, TINY) - 1.0
                damping *= max(1.0 - held**3, _LEAST_KEPT)
                damping = 0.0 if damping < _LEAST_DAMPING else damping
                growth = _GROWTH
                state, cost = trial, trial_cost
                information, next_information = next_information, information
                slope, next_slope = next_slope, slope
            if converged:
                break
        if accepted:
            continue
        damping, growth = max(growth * damping, _FIRST_DAMPING), 2.0 * growth
        if damping > _MOST_DAMPING:
            break
    return state, information, cost, converged


@inlined
def anneal(
    data: Array, start: Array, first_scale: float, last_scale: float,
    prior: PriorTerms, noise: float,
) -> Array:  # fmt: skip
    """State after one Gauss-Newton step at each scale of Tukey's loss, from the first to the last.

    No step is tried twice: the next scale judges the points anew (graduated non-convexity).
    """
    state = start
    information = np.empty((MOTION_PARAMETERS, MOTION_PARAMETERS))
    slope = np.empty(MOTION_PARAMETERS)
    scale = first_scale
    while scale > last_scale:
        _posterior(data, state, (scale, 1.0), prior, noise, 1, information, slope)
        for i in range(MOTION_PARAMETERS):
            information[i, i] *= 1.0 + _ANNEALING_DAMPING
        step, solved = solve_positive(information, -slope)
        if not solved:
            break
        state = apply_step(state, step)
        scale *= _ANNEALING_RATIO
    return state


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
    inside = squared_errors[squared_errors < gate * gate]
    left = 2.0 * len(inside) - freedom
    if left <= 0.0:
        return gate / GATE
    mean = float(np.sum(inside)) / left
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
    total = 1.0 * len(inverse)
    for term in range(len(prior.informations)):
        total -= noise * noise * np.sum(inverse * prior.informations[term])
    return max(total, 0.0)


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
            weighted(data, weights), state, (_NO_SCALE, 0.0), prior, noise, 2, _ITERATIONS,
            _FIRST if turn == 0 else _LATER,
        )  # fmt: skip
        errors = squared_errors(data, count, state)
        inverse = inverted(information)
        # The prior takes its part of the parameters that the points decide.
        freedom = decided(inverse, prior, noise)
        noise = noise_deviation(errors, gate, freedom)
        gate = min(max(threshold, GATE * noise), WIDEST_GATE * threshold)
    inliers = errors < gate * gate
    # The least eigenvalue for a unit diagonal is more than this, at most 18 times.
    total = np.sum(np.diag(inverse) * np.diag(information))
    return Best(
        state, noise * noise * inverse, noise, 2.0 * np.sum(inliers) - freedom,
        1.0 / total if total > 0.0 else 0.0, inliers, errors,
    )  # fmt: skip
