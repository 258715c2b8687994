# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Refinement of a motion on many points: Levenberg-Marquardt in model B, with a prior.

Parameters of a step, as in ``Estimate.covariance``: the camera turns by ``exp([phi]x)`` in its own
axes, moves by ``rho`` along them, and velocities and accelerations change additively.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2
from rs_localizer.core.so3 import exp
from rs_localizer.core.state import MOTION_PARAMETERS, PARAMETERS, STATE_SIZE
from rs_localizer.estimation.prior import PriorTerms, add_prior
from rs_localizer.estimation.residuals import normal_equations
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
# Pivots of a matrix of unit diagonal below this are rounding errors.
_SINGULAR = 1e-15
# More damping halts in the flat valleys of fast planes; less damping loses planes that face the
# camera.
_ANNEALING_DAMPING, _ANNEALING_RATIO = 1e-4, 0.6


@entry
def apply_step(state: Array1, step: Array1) -> Array:
    """Move a state by a step (18,), or (12,) that leaves the accelerations."""
    turn = exp(-step[0:3])
    moved = np.empty(STATE_SIZE)
    for i in range(3):
        for j in range(3):
            moved[3 * i + j] = (
                turn[i, 0] * state[j] + turn[i, 1] * state[3 + j] + turn[i, 2] * state[6 + j]
            )
        moved[9 + i] = (
            turn[i, 0] * (state[9] - step[3])
            + turn[i, 1] * (state[10] - step[4])
            + turn[i, 2] * (state[11] - step[5])
        )
    for i in range(12, STATE_SIZE):
        moved[i] = state[i] + (step[i - 6] if i - 6 < len(step) else 0.0)
    return moved


@entry
def solve_positive(matrix: Array2, right: Array1) -> tuple[Array, bool]:
    """Solve a symmetric positive definite system by Cholesky; return whether it is one."""
    size = len(right)
    # Scaling to a unit diagonal makes radians and metres comparable.
    scale = np.empty(size)
    for i in range(size):
        if not matrix[i, i] > 0.0:
            return right, False
        scale[i] = 1.0 / np.sqrt(matrix[i, i])
    factor = np.empty((size, size))
    solution = np.empty(size)
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > _SINGULAR:
                    return right, False
                factor[i, i] = np.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
        total = right[i] * scale[i]
        for k in range(i):
            total -= factor[i, k] * solution[k]
        solution[i] = total / factor[i, i]
    for i in range(size - 1, -1, -1):
        total = solution[i]
        for k in range(i + 1, size):
            total -= factor[k, i] * solution[k]
        solution[i] = total / factor[i, i]
    for i in range(size):
        solution[i] *= scale[i]
    return solution, True


@kernel
def _posterior(
    data: Array,
    state: Array,
    scale: float,
    softness: float,
    prior: PriorTerms,
    noise: float,
    looks: int,
    information: Array,
    slope: Array,
) -> float:
    """Return normal equations and cost with the prior, in squared pixels."""
    cost = normal_equations(data, state, scale, softness, looks, information, slope)
    return cost + add_prior(prior, state, noise * noise, information, slope)


@entry
def refine(
    data: Array2,
    start: Array1,
    scale: float,
    softness: float,
    prior: PriorTerms,
    noise: float,
    looks: int,
    iterations: int,
    tolerance: float,
) -> tuple[Array, Array, float, bool]:
    """Minimize the robust cost of all points plus the prior.

    Args:
        data: packed points, with weights.
        start: state (24,).
        scale, softness: of the robust loss, see :mod:`rs_localizer.estimation.residuals`.
        prior: see :mod:`rs_localizer.estimation.prior`.
        noise: standard deviation of the pixels, against which the prior is weighed.
        looks: at each point's row, 1 or 2 (see :class:`rs_localizer.estimation.residuals.View`);
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
    cost = _posterior(data, state, scale, softness, prior, noise, looks, information, slope)
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
                data, trial, scale, softness, prior, noise, looks,
                next_information, next_slope,
            )  # fmt: skip
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
        _posterior(data, state, scale, 1.0, prior, noise, 1, information, slope)
        for i in range(MOTION_PARAMETERS):
            information[i, i] *= 1.0 + _ANNEALING_DAMPING
        step, solved = solve_positive(information, -slope)
        if not solved:
            break
        state = apply_step(state, step)
        scale *= _ANNEALING_RATIO
    return state


@kernel
def half_inverse(matrix: Array) -> tuple[Array, Array, bool]:
    """Lower triangle ``H`` and scales ``s`` of a symmetric positive definite matrix's inverse,
    ``diag(s) H^T H diag(s)``, and whether it is one; by Cholesky.

    Scaled to a unit diagonal first, so that units do not matter, nor parameters that a prior holds.
    """
    size = len(matrix)
    scale, factor = np.empty(size), np.empty((size, size))
    half = np.zeros((size, size))  # inverse of the factor
    for i in range(size):
        if not matrix[i, i] > 0.0:
            return half, scale, False
        scale[i] = 1.0 / np.sqrt(matrix[i, i])
    for i in range(size):
        own = factor[i]
        for j in range(i + 1):
            other = factor[j]
            total = matrix[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= own[k] * other[k]
            if i > j:
                own[j] = total * half[j, j]
            elif total > _SINGULAR:
                own[i] = np.sqrt(total)
            else:
                return half, scale, False
        row, inverse = half[i], 1.0 / own[i]
        for k in range(i):  # along the rows, for the sake of the caches
            above = half[k]
            for j in range(k + 1):
                row[j] -= own[k] * above[j]
        for j in range(i):
            row[j] *= inverse
        row[i] = inverse
    return half, scale, True


@entry
def inverted(matrix: Array2) -> Array:
    """Return the inverse of a symmetric positive definite matrix; NaN if it is none."""
    half, scale, positive = half_inverse(matrix)
    return squared(half, scale) if positive else np.full(matrix.shape, np.nan)


@kernel
def squared(half: Array, scale: Array) -> Array:
    """Return the inverse whose half :func:`half_inverse` is."""
    size = len(scale)
    inverse = np.zeros((size, size))
    for k in range(size):
        row = half[k]
        for i in range(k + 1):
            total, factor = inverse[i], row[i]
            for j in range(i + 1):
                total[j] += factor * row[j]
    for i in range(size):
        for j in range(i + 1):
            inverse[i, j] *= scale[i] * scale[j]
            inverse[j, i] = inverse[i, j]
    return inverse


@entry
def smallest_eigenvalue(information: Array2) -> float:
    """Return the least eigenvalue of information scaled to a unit diagonal; 0 if none."""
    size = len(information)
    scaled = np.empty((size, size))
    for i in range(size):
        if not information[i, i] > 0.0:
            return 0.0
    for i in range(size):
        for j in range(size):
            scaled[i, j] = information[i, j] / np.sqrt(information[i, i] * information[j, j])
            if not np.isfinite(scaled[i, j]):
                return 0.0
    smallest: float = np.linalg.eigvalsh(scaled)[0]
    return smallest
