# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""In-frame turn beside the motion: a Gaussian process in row time, marginalized in closed form.

With the columns ``T`` of what the rows of one readout resolve (:mod:`rs_localizer.core.shake`),
whole cosines and sines, so that ``y`` is the motion without its vibration,

    e = M y + T k + S f + noise,      k ~ N(0, t^2 C)

for some spectra ``C`` and sizes ``t``. Once the motion is taken out (Schur's complement, with
``N = T^T W T`` and ``h = T^T W e`` beside it), each of them is one tridiagonal system away:

    log evidence = -log det(1 + t^2/n^2 L^T N L) / 2
                   - freedom / 2 log(1 - h^T L (n^2/t^2 + L^T N L)^-1 L^T h / rest)

in Student's form, because the noise is of the same errors. Spectra and sizes are integrated.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, BoolArray, BoolArray1
from rs_localizer.core.shake import (
    COMBINATIONS,
    CYCLES,
    FUNCTIONS,
    IN_COMBINATIONS,
    MIDDLE_RATES,
    MIDDLE_VALUES,
    RESOLVED,
    TYPICAL_SIZES,
    shake_at,
    shake_basis,
)
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.correlated import (
    SmoothError,
    smooth_error,
    taken_by,
    volume_of,
)
from rs_localizer.estimation.posterior import GATE, WIDEST_GATE
from rs_localizer.estimation.prior import PriorTerms, add_prior
from rs_localizer.estimation.refine import LEAST_NOISE, TINY, apply_step, half_inverse, squared
from rs_localizer.estimation.residuals import POINT_SIZE, Lines, linearized, squared_errors
from rs_localizer.native import entry, inlined, kernel

TURNS = 3 * RESOLVED
"""Columns of the in-frame turn."""
_CENTRES, _WIDTH, _FLOOR = (0.75, 1.5, 3.0, 5.0), 0.4, 0.03
_BANDS = np.exp(-0.5 * (np.log(CYCLES[None] / np.array(_CENTRES)[:, None]) / _WIDTH) ** 2) + _FLOOR
SPECTRA = np.concatenate([
    TYPICAL_SIZES[None],
    _BANDS * np.sqrt((TYPICAL_SIZES**2).sum() / (_BANDS**2).sum(axis=1))[:, None],
])  # fmt: skip
"""(s,14) rad, deviations of the frequencies of the in-frame turn: of an ordinary vibration, and of
bands about some cycles per readout, all of the same mean square."""
FACTORS = np.exp(1.15 * np.arange(-2.0, 5.0))
"""Vibration is so many times the ordinary one: three in a decade, up to a degree."""


def _halves() -> Array:
    """Root ``L`` (54,54) of each spectrum's covariance ``L L^T`` of the columns."""
    halves = []
    for sizes in SPECTRA:
        spread = IN_COMBINATIONS @ np.diag(np.repeat(sizes, 2) ** 2) @ IN_COMBINATIONS.T
        values, axes = np.linalg.eigh(spread)
        halves.append(np.kron(axes * np.sqrt(np.maximum(values, 0.0)), np.eye(3)))
    return np.array(halves)


_HALVES = _halves()
# How each column turns the middle row, and how fast: of whole cosines and sines.
_VALUES, _RATES = MIDDLE_VALUES @ COMBINATIONS, MIDDLE_RATES @ COMBINATIONS
# Deviation of the logarithm of the size of vibration: a decade.
_DECADE = math.log(10.0)
_OF_FACTORS = -0.5 * (np.log(FACTORS) / _DECADE) ** 2
_OF_FACTORS -= np.log(np.exp(_OF_FACTORS).sum()) + math.log(len(SPECTRA))
# Of products, what rounding may take of those of columns that the motion mimics.
_RIDGE = 1e-9
# Vibrations less probable than this beside the best one have no part.
_NO_PART = 1e-3
# Errors that are left at least: the linear model holds no farther.
_LEAST_LEFT = 1e-4
# Logarithm of the evidence of the ordinary spectrum, one of several, from which all are looked at.
_MAY_SHAKE = -1.8
# The gate closes by this factor from step to step (graduated non-convexity).
_CLOSING = 0.6
# A last step this short, in squared standard deviations: the next one is its square.
_SHORT = 1e-2
_STEPS = 20
# Fewer inliers determine nothing.
_FEWEST = 8


class TurnFit(NamedTuple):
    """Motion and in-frame turn, integrated over spectra and sizes of vibration."""

    state: Array  # (24,), with its vibration
    turns: Array  # (28,3) rad, coefficients of the in-frame turn
    covariance: Array  # (18 + 84,18 + 84), by noise and priors
    noise: float  # px
    freedom: float
    inliers: BoolArray  # (n,)
    squared_errors: Array  # (n,) px^2, beside the in-frame turn
    evidence: float  # logarithm, of all vibrations but none
    gain: float  # logarithm of the evidence over that of none at the same motion
    finite: bool


class _Turned(NamedTuple):
    """Products beside the motion; px^2."""

    own: Array  # (54,54)
    along: Array  # (54,)
    crossed: Array  # (18,54) of motion and turn
    slope: Array  # (18,)
    inverse: Array  # (18,18) of the information of the motion, times the noise variance
    rest: float  # px^2, that the motion alone leaves
    log_determinant: float  # of the information of the motion, times the noise variance


@inlined
def _columns(lines: Lines, chosen: BoolArray, count: int) -> Array:
    """Columns (2m,73) of motion, in-frame turn and errors of the chosen points."""
    rows, place = np.empty((2 * count, PARAMETERS + TURNS + 1)), 0
    values, rates, each = np.empty(FUNCTIONS), np.empty(FUNCTIONS), np.empty(RESOLVED)
    for i in range(len(chosen)):
        if not chosen[i]:
            continue
        shake_basis(lines.tau[i], values, rates)
        for j in range(RESOLVED):
            total = 0.0
            for k in range(FUNCTIONS):
                total += values[k] * COMBINATIONS[k, j]
            each[j] = total
        for side in range(2):
            row, motion, turn = rows[place], lines.by_motion[i, side], lines.by_turn[i, side]
            for k in range(PARAMETERS):
                row[k] = motion[k]
            for j in range(RESOLVED):
                for axis in range(3):
                    row[PARAMETERS + 3 * j + axis] = (
                        each[j] * turn[axis] + _VALUES[j] * motion[axis]
                        + _RATES[j] * motion[6 + axis]
                    )  # fmt: skip
            row[PARAMETERS + TURNS] = lines.errors[i, side]
            place += 1
    return rows


@inlined
def _middle(turns: Array, sign: float) -> Array:
    """Step (18,) by which coefficients (54,) turn the middle row, and how fast."""
    step = np.zeros(PARAMETERS)
    for j in range(RESOLVED):
        for axis in range(3):
            step[axis] += sign * _VALUES[j] * turns[3 * j + axis]
            step[6 + axis] += sign * _RATES[j] * turns[3 * j + axis]
    return step


@kernel
def _beside_motion(
    rows: Array, smooth: SmoothError, size: float, noise: float, turns: Array, terms: PriorTerms,
    still: Array,
) -> _Turned:  # fmt: skip
    """Take motion and smooth error out of the columns.

    Args:
        turns: (54,) where the errors are linearized.
        still: state (24,) without its vibration.
    """
    last, variance = PARAMETERS + TURNS, noise * noise
    for i in range(len(rows)):  # as errors of no vibration
        row, shown = rows[i], 0.0
        for k in range(TURNS):
            shown += row[PARAMETERS + k] * turns[k]
        row[last] -= shown
    every, beside = rows.T @ rows, smooth.rows.T @ rows
    taken = taken_by(smooth.squares, size, noise)
    weighted = beside.copy()
    for k in range(len(taken)):
        weighted[k] *= taken[k]
    every = every - beside.T @ weighted
    matrix, slope = every[:PARAMETERS, :PARAMETERS].copy(), every[:PARAMETERS, last].copy()
    cost = add_prior(terms, still, variance, matrix, slope)
    half, scale, positive = half_inverse(matrix)
    inverse, log_determinant = squared(half, scale), 0.0
    if not positive:
        inverse[:] = np.nan
    for k in range(PARAMETERS):
        log_determinant -= 2.0 * math.log(max(half[k, k] * scale[k], TINY))
    crossed = every[:PARAMETERS, PARAMETERS:last].copy()
    pulled = inverse @ crossed
    own = every[PARAMETERS:last, PARAMETERS:last] - crossed.T @ pulled
    for k in range(TURNS):  # columns that the motion mimics wholly explain nothing
        own[k, k] += _RIDGE * every[PARAMETERS + k, PARAMETERS + k]
    along = every[PARAMETERS:last, last] - pulled.T @ slope
    rest = every[last, last] + cost - np.sum(slope * (inverse @ slope))
    return _Turned(own, along, crossed, slope, inverse, rest, log_determinant)


class _Vibrating(NamedTuple):
    turns: Array  # (54,) mean
    covariance: Array  # (54,54)
    variance: float  # px^2, of the noise
    gain: float  # logarithm of the evidence of all, against none


class _Tridiagonal(NamedTuple):
    """``Q^T A Q`` of symmetric matrices A (s,n,n), by Householder's reflections."""

    diagonal: Array  # (s,n)
    off: Array  # (s,n) beside it; the last is 0
    axes: Array  # (s,n,n) rows: v of ``Q = (I - v_0 v_0^T) (I - v_1 v_1^T) ...``
    along: Array  # (s,n) Q^T h


@kernel
def _reduce(matrix: Array, place: int, out: _Tridiagonal) -> None:
    """Fill in one place; ``out.along`` holds h there. The matrix is overwritten."""
    size = len(matrix)
    out.off[place] = 0.0
    out.axes[place] = 0.0
    for k in range(size - 1):
        # Loops over slices from zero are what the compiler makes vectors of.
        left, row, rest = size - k - 1, matrix[k, k + 1 :], matrix[k + 1 :, k + 1 :]
        axis, along = out.axes[place, k, k + 1 :], out.along[place, k + 1 :]
        length, head = 0.0, row[0]
        for i in range(left):
            length += row[i] * row[i]
        length = math.copysign(math.sqrt(length), -head)  # the sign that avoids cancellation
        out.diagonal[place, k], out.off[place, k] = matrix[k, k], length
        half = length * (length - head)  # half of the squared length of the axis
        if not half > 0.0:
            continue
        scale = 1.0 / math.sqrt(half)
        for i in range(left):
            axis[i] = row[i] * scale
        axis[0] = (head - length) * scale
        pulled = row  # it is not needed again
        for i in range(left):
            pulled[i] = 0.0
        for i in range(left):
            other, part = rest[i], axis[i]
            for j in range(left):
                pulled[j] += part * other[j]
        own, shown = 0.0, 0.0
        for i in range(left):
            own += 0.5 * axis[i] * pulled[i]
            shown += axis[i] * along[i]
        for i in range(left):
            pulled[i] -= own * axis[i]
            along[i] -= shown * axis[i]
        for i in range(left):
            other, one, two = rest[i], axis[i], pulled[i]
            for j in range(left):
                other[j] -= one * pulled[j] + two * axis[j]
    out.diagonal[place, size - 1] = matrix[size - 1, size - 1]


@inlined
def _back(axes: Array, half: Array) -> Array:
    """``Q^T L^T`` (n,n) of a spectrum's root L and the axes (n,n) of its reflections."""
    back, size = half.T.copy(), len(half)
    pulled = np.empty(size)
    for k in range(size - 1):
        axis = axes[k]
        pulled[:] = 0.0
        for i in range(k + 1, size):
            row, part = back[i], axis[i]
            for j in range(size):
                pulled[j] += part * row[j]
        for i in range(k + 1, size):
            row, part = back[i], axis[i]
            for j in range(size):
                row[j] -= part * pulled[j]
    return back


@kernel
def _solved(diagonal: Array, off: Array, along: Array, part: float, mean: Array) -> tuple[
    float, float
]:  # fmt: skip
    """``h^T A^-1 h`` and half the log-determinant of ``A = I + part T``, T tridiagonal; ``mean``
    becomes ``-part A^-1 h``.

    No pivot is less than one but by rounding, where the motion mimics a column.
    """
    size, determinant, squares = len(diagonal), 0.0, 0.0
    pivots, before, carried = np.empty(size), 0.0, 0.0
    for i in range(size):
        pivots[i] = max(1.0 + part * diagonal[i] - before * carried, 1.0)
        mean[i] = along[i] - (carried * mean[i - 1] if i else 0.0)
        before = part * off[i]
        carried = before / pivots[i]
    for i in range(size):
        squares += mean[i] ** 2 / pivots[i]
        determinant += 0.5 * math.log(pivots[i])
    after = 0.0
    for i in range(size - 1, -1, -1):
        after = (mean[i] - part * off[i] * after) / pivots[i]
        mean[i] = after
    for i in range(size):
        mean[i] *= -part
    return squares, determinant


@kernel
def _add_inverse(diagonal: Array, off: Array, part: float, weight: float, total: Array) -> None:
    """Add ``weight (I + part T)^-1``, T tridiagonal, from its pivots from above and from below."""
    size = len(diagonal)
    below = np.empty(size + 1)
    below[size] = 1.0
    for i in range(size - 1, -1, -1):
        below[i] = max(1.0 + part * diagonal[i] - (part * off[i]) ** 2 / below[i + 1], 1.0)
    above = 0.0  # what the rows above take of a pivot
    for i in range(size):
        entry = weight / max(below[i] - above, 1.0)
        above = (part * off[i]) ** 2 / max(1.0 + part * diagonal[i] - above, 1.0)
        total[i, i] += entry
        for j in range(i + 1, size):
            entry = -entry * part * off[j - 1] / below[j]
            total[i, j] += entry
            total[j, i] += entry


@kernel
def _integrate(turned: _Turned, noise: float, freedom: float, first: int) -> _Vibrating:
    """Integrate over spectra and sizes.

    Each spectrum is brought to tridiagonal form once, which costs as much as two or three of the
    Cholesky factors that each size would need.

    Args:
        first: how many spectra are looked at.
    """
    factors, rest, variance = len(FACTORS), max(turned.rest, TINY), noise * noise
    variances, means = np.empty(first * factors), np.empty((first * factors, TURNS))
    weights = np.empty(first * factors)
    form = _Tridiagonal(
        np.empty((first, TURNS)), np.empty((first, TURNS)), np.empty((first, TURNS, TURNS)),
        np.empty((first, TURNS)),
    )  # fmt: skip
    for s in range(first):
        half = _HALVES[s]
        form.along[s] = half.T @ turned.along
        _reduce(half.T @ turned.own @ half, s, form)
        for f in range(factors):
            place, part = s * factors + f, FACTORS[f] ** 2 / variance
            explained, determinant = _solved(
                form.diagonal[s], form.off[s], form.along[s], part, means[place]
            )
            left = max(1.0 - part * explained / rest, _LEAST_LEFT)
            variances[place] = rest * left / freedom
            weights[place] = _OF_FACTORS[f] - determinant - 0.5 * freedom * math.log(left)
    top = np.max(weights)
    weights = np.exp(weights - top)
    total = np.sum(weights)
    turns, covariance = np.zeros(TURNS), np.zeros((TURNS, TURNS))
    mean_variance = 0.0
    for s in range(first):
        mean, spread, counts = np.zeros(TURNS), np.zeros((TURNS, TURNS)), False
        for f in range(factors):
            place, part = s * factors + f, FACTORS[f] ** 2 / variance
            weight = weights[place] / total
            if weight < _NO_PART:
                continue
            counts = True
            mean_variance += weight * variances[place]
            own = weight * variances[place] * part
            _add_inverse(form.diagonal[s], form.off[s], part, own, spread)
            for i in range(TURNS):
                mean[i] += weight * means[place, i]
                for j in range(TURNS):
                    spread[i, j] += weight * means[place, i] * means[place, j]
        if counts:
            back = _back(form.axes[s], _HALVES[s])
            turns += mean @ back
            covariance += back.T @ spread @ back
    covariance -= turns.reshape(TURNS, 1) * turns.reshape(1, TURNS)
    return _Vibrating(turns, covariance, mean_variance, top + math.log(total))


@kernel
def _joint(turned: _Turned, covariance: Array, variance: float) -> Array:
    """Covariance (72,72) of motion without vibration, and turn, from that of the turn."""
    size = PARAMETERS + TURNS
    joint = np.zeros((size, size))
    pulled = -turned.inverse @ turned.crossed
    across = pulled @ covariance
    joint[:PARAMETERS, :PARAMETERS] = variance * turned.inverse + across @ pulled.T
    joint[:PARAMETERS, PARAMETERS:] = across
    joint[PARAMETERS:, :PARAMETERS] = across.T
    joint[PARAMETERS:, PARAMETERS:] = covariance
    return joint


@entry
def hidden_turn(
    lines: Lines, state: Array1, inliers: BoolArray1, smooth: SmoothError, size: float,
    terms: PriorTerms, noise: float, freedom: float,
) -> tuple[float, Array]:  # fmt: skip
    """Effect and evidence of vibration at the best motion without it.

    Returns:
        logarithm of its evidence, against none; (18,18) second moments of the motion by it.
    """
    rows = _columns(lines, inliers, int(np.count_nonzero(inliers)))
    turned = _beside_motion(rows, smooth, size, noise, np.zeros(TURNS), terms, state)
    moments = np.zeros((PARAMETERS, PARAMETERS))
    if not np.all(np.isfinite(turned.own)):
        return -np.inf, moments
    found = _integrate(turned, noise, max(freedom, 1.0), 1)
    if found.gain > _MAY_SHAKE:
        found = _integrate(turned, noise, max(freedom, 1.0), len(SPECTRA))
    pulled = np.zeros((PARAMETERS, TURNS))
    pulled[:] = -turned.inverse @ turned.crossed
    for j in range(RESOLVED):
        for axis in range(3):
            pulled[axis, 3 * j + axis] += _VALUES[j]
            pulled[6 + axis, 3 * j + axis] += _RATES[j]
    second = found.covariance + found.turns.reshape(TURNS, 1) * found.turns.reshape(1, TURNS)
    return found.gain, pulled @ second @ pulled.T


@inlined
def _row_times(data: Array, count: int) -> Array:
    """Measured row times (n,) of packed points."""
    lanes = data.shape[1] // POINT_SIZE
    tau = np.empty(count)
    for i in range(count):
        tau[i] = data[i // lanes, 5 * lanes + i % lanes]
    return tau


@entry
def fit_turn(
    data: Array2, count: int, start: Array1, terms: PriorTerms, threshold: float, first_gate: float,
    first_noise: float, bend: Array2, log_size: float, focal_length: float,
) -> TurnFit:  # fmt: skip
    """Fit motion and in-frame turn, the noise and the inliers.

    Args:
        start: state (24,).
        terms: of the motion without its in-frame turn.
        threshold: px, of inliers.
        first_gate, first_noise: px; the gate closes from there to what the noise decides.
        bend: of the smooth error (:func:`.correlated.smooth_columns`).
        log_size: of the smooth error (px).
    """
    state, turns, gate, noise = start.copy(), np.zeros(TURNS), first_gate, first_noise
    coefficients, size = np.zeros((FUNCTIONS, 3)), math.exp(log_size)
    tau = _row_times(data, count)
    lines = linearized(data, count, state, np.zeros((count, 6)))
    front = squared_errors(data, count, state)
    squares = front.copy()
    inliers, done, finite = squares < gate * gate, False, True
    nothing = np.zeros((PARAMETERS + TURNS, PARAMETERS + TURNS))
    joint, evidence, gain = nothing, -np.inf, -np.inf
    freedom, moved, used = 1.0, np.inf, 0.0
    for _ in range(_STEPS):
        kept = int(np.count_nonzero(inliers))
        if kept < _FEWEST:
            finite = False
            break
        smooth = smooth_error(lines, inliers, bend, log_size)
        still = apply_step(state, _middle(turns, -1.0))
        rows = _columns(lines, inliers, kept)
        turned = _beside_motion(rows, smooth, size, noise, turns, terms, still)
        freedom = max(2.0 * kept - PARAMETERS - np.sum(taken_by(smooth.squares, size, noise)), 1.0)
        if not (np.all(np.isfinite(turned.own)) and np.all(np.isfinite(turned.along))):
            finite = False
            break
        found = _integrate(turned, noise, freedom, len(SPECTRA))
        gain, change = found.gain, found.turns - turns
        step = -turned.inverse @ (turned.slope + turned.crossed @ found.turns)
        joint = _joint(turned, found.covariance, found.variance)
        used = np.sum(turned.own * found.covariance) / found.variance
        moved = 0.0
        for k in range(PARAMETERS):
            moved = max(moved, step[k] ** 2 / max(joint[k, k], TINY))
        for k in range(TURNS):
            moved = max(moved, change[k] ** 2 / max(found.covariance[k, k], TINY))
        still_variance = max(turned.rest, TINY) / freedom
        base = 2.0 * kept * math.log(2.0 * math.pi * still_variance) + freedom
        base += turned.log_determinant - PARAMETERS * math.log(still_variance)
        for k in range(len(smooth.squares)):
            base += math.log1p(size * size * smooth.squares[k] / (noise * noise))
        evidence = volume_of(terms) - 0.5 * base + gain
        evidence -= 2.0 * (count - kept) * math.log(focal_length)
        state = apply_step(state, step + _middle(change, 1.0))
        turns = found.turns
        for k in range(FUNCTIONS):
            for axis in range(3):
                total = 0.0
                for j in range(RESOLVED):
                    total += COMBINATIONS[k, j] * turns[3 * j + axis]
                coefficients[k, axis] = total
        lines = linearized(data, count, state, shake_at(tau, coefficients))
        front = squared_errors(data, count, state)
        for i in range(count):
            squares[i] = front[i]
            if np.isfinite(front[i]):
                squares[i] = lines.errors[i, 0] ** 2 + lines.errors[i, 1] ** 2
        if not np.all(np.isfinite(state)):
            finite = False
            break
        if done:
            break
        closed = gate <= WIDEST_GATE * threshold
        noise = max(math.sqrt(found.variance), LEAST_NOISE)
        gate = max(_CLOSING * gate, min(max(threshold, GATE * noise), WIDEST_GATE * threshold))
        inliers = squares < gate * gate
        done = closed and moved < _SHORT
    finite = finite and bool(np.all(np.isfinite(joint))) and moved < 1.0
    whole = _in_functions(joint)
    return TurnFit(
        state, coefficients, whole, noise, max(freedom - used, 1.0), inliers, squares, evidence,
        gain, finite,
    )  # fmt: skip


@kernel
def _in_functions(joint: Array) -> Array:
    """Covariance (102,102) of the motion with its vibration and of all functions' coefficients."""
    size = PARAMETERS + TURNS
    by = np.zeros((PARAMETERS + 3 * FUNCTIONS, size))
    for i in range(PARAMETERS):
        by[i, i] = 1.0
    for j in range(RESOLVED):
        for axis in range(3):
            place = PARAMETERS + 3 * j + axis
            by[axis, place], by[6 + axis, place] = _VALUES[j], _RATES[j]
            for k in range(FUNCTIONS):
                by[PARAMETERS + 3 * k + axis, place] = COMBINATIONS[k, j]
    return by @ joint @ by.T
