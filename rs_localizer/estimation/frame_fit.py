# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""One fit: motion, in-frame turn, smooth errors and the scales of all of them, from the inliers.

The model of a frame (docs/estimator.md): a pixel is where the motion ``x`` and the in-frame turn
``d`` put it, plus an error ``f`` that is smooth over the image, plus noise. Linearized at a state,

    errors = A_x x + A_d d + A_f f + noise,     x ~ prior, d_k ~ N(0, s_k^2), f ~ N(0, s_f^2)

is a linear Gaussian model whose scales are estimated with it: type-II maximum likelihood (MacKay,
"Bayesian interpolation", 1992; Tipping, "Sparse Bayesian learning", 2001), one scale per frequency
of the in-frame turn and one for the smooth error, each with a Gaussian hyperprior on its logarithm.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import legvander

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.scales import SCALES
from rs_localizer.core.shake import (
    FUNCTIONS,
    MIDDLE_RATES,
    MIDDLE_VALUES,
    shake_at,
    shake_basis,
)
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.state import ANGULAR, PARAMETERS, POSE
from rs_localizer.estimation.posterior import GATE, WIDEST_GATE, noise_deviation
from rs_localizer.estimation.prior import PriorTerms, add_prior, terms_at
from rs_localizer.estimation.refine import (
    LEAST_NOISE,
    TINY,
    apply_step,
    half_inverse,
    inverted,
    squared,
)
from rs_localizer.estimation.residuals import POINT_SIZE, Lines, linearized, squared_errors

SMOOTH_DEGREE = 3
SMOOTH_TERMS = (SMOOTH_DEGREE + 1) * (SMOOTH_DEGREE + 2) // 2
TURNS = 3 * FUNCTIONS
# Expected size of each degree: printers stretch paper, lenses bend at the rim; the mean square
# over the image of a field of scale 1 is 1.
DEGREE_SIZES = (1.0, 1.0, 0.5, 0.25)
_TERM_SIZES = np.array(
    [
        DEGREE_SIZES[degree] * math.sqrt((2 * i + 1) * (2 * (degree - i) + 1))
        for degree in range(SMOOTH_DEGREE + 1)
        for i in range(degree + 1)
    ]
) / math.sqrt(sum((d + 1) * size**2 for d, size in enumerate(DEGREE_SIZES)))
# Paper bends in finer waves than lenses: to a cubic a curled edge looks like fast motion. A fourth
# degree adds 1.7 to the log-evidence of a frame in the mean of eleven of these boards, 15 to 92
# before two bent ones; with higher degrees that are larger (0.25, 0.5), flat boards lose.
_BENT_SIZES = (*DEGREE_SIZES, 0.125)
# Combinations of functions that move no point by this part of the scale are left out.
_LEAST_BEND = 0.003
_LEAST_EXTENT = 1e-6  # m; points nearer together than this are one place, and nothing bends
# A column whose scale moves no point by this part of the noise is left out: it changes nothing.
_NEGLIGIBLE = 0.03
# Neighbouring frequencies have scales alike to a factor of e (precision of the difference of their
# logarithms): what one readout shows of a tone leaks into those beside it (Rayleigh).
_SMOOTH_SPECTRUM = 1.0
# Newton's steps of a log-scale are held to a factor of e.
_LONGEST_SCALE_STEP = 1.0
# Logarithms of scales stay within these: 1e-6 rad is a thousandth of a pixel at f = 1000.
_LEAST_LOG_SCALE, _MOST_LOG_SCALE = math.log(1e-6), math.log(30.0)
# Rounds of scales in the first steps, in which the gate closes, and in those that follow. With four
# in all, vibration is told as well in 15 % less time, but a large smooth error is not found before
# the gate has closed on it: a curled sheet jitters 1.12 times as much as P3P, not 0.84 times
# (benchmarks.real, sj).
_SCALE_ROUNDS, _LATER_SCALE_ROUNDS = 12, 4
# Rounds end before that where no scale would change by more than this part: a hundredth of its own
# deviation, as no frame tells one to better than a fifth.
_SETTLED = 2e-3
# Every second step of them goes this many times as far at most, as the last two steps foresee.
_FARTHEST = 3.0
# Of the diagonal: what nothing determines has an inverse.
_RIDGE = 1.0 + 1e-13
# The gate closes by this factor from step to step (graduated non-convexity).
_CLOSING = 0.6
# A last step this short, in squared standard deviations: the next one is its square.
_SHORT = 1e-3
# A step that raises the cost is halved, up to a thirtieth: two hold small planes, none loses them.
_HALVINGS = 6
# Fewer inliers determine nothing.
_FEWEST = 6
# Points nearer than this part of the image that the points fill are neighbours in it.
_FAR_APART = 0.15


class Products(NamedTuple):
    """Products of all columns over the inliers: motion, in-frame turn, smooth error."""

    products: Array  # (m,m)
    with_errors: Array  # (m,) with the negative errors
    squared_errors: float  # px^2


class FrameFit(NamedTuple):
    """A mode of the posterior of a frame: the Laplace approximation about an optimum."""

    state: Array  # (24,)
    turns: Array  # (28,3) rad, coefficients of the in-frame turn; zeros without one
    # (18 + 84,18 + 84), or (18,18) without an in-frame turn: by the noise and what the prior allows
    covariance: Array
    # (18 + 84,q), or (18,q): what a smooth error of the size of its scale does to them
    by_smooth: Array
    noise: float  # px
    freedom: float
    inliers: BoolArray  # (n,)
    squared_errors: Array  # (n,) px^2, beside the in-frame turn and the smooth error
    log_scales: Array  # (15,)
    decided: Array  # (15,) how many coefficients of each scale the points decide
    smooth: float  # scale of the smooth error: its expected root mean square
    agreement: float  # of neighbouring rows (see neighbours_agree)
    evidence: float  # logarithm, but for a constant of the inliers
    left: float  # squared errors beside all, in variances of the noise
    prior_cost: float  # of motion, coefficients and scales
    log_determinant: float  # of the covariance over that of the prior of coefficients and scales
    finite: bool


@kernel
def products_of(
    lines: Lines, inliers: BoolArray, errors: Array, turns: bool, smooth: bool, bend: Array
) -> Products:
    """Multiply the columns of the inliers with each other and with their errors (n,2).

    ``bend`` (n,b): see :func:`fit_frame`.
    """
    first = PARAMETERS + (TURNS if turns else 0)
    size = first + (smooth_size(bend) if smooth else 0)
    matrix, right, square = np.zeros((size, size)), np.zeros(size), 0.0
    low, high = extent(lines, inliers)
    values, rates, terms = np.empty(FUNCTIONS), np.empty(FUNCTIONS), np.zeros(SMOOTH_TERMS)
    rows = np.zeros((2, size))
    for i in range(len(inliers)):
        if not inliers[i]:
            continue
        if turns:
            shake_basis(lines.tau[i], values, rates)
        if smooth and bend.shape[1] == 0:
            smooth_terms(lines.image[i], low, high, terms)
        for side in range(2):
            _fill(rows[side], lines.by_motion[i, side], lines.by_turn[i, side], values, turns)
            if smooth and bend.shape[1] == 0:
                rows[side, first + SMOOTH_TERMS * side : first + SMOOTH_TERMS * (side + 1)] = terms
            elif smooth:
                _fill_bend(rows[side, first:], lines.by_motion[i, side], bend[i])
        square += errors[i, 0] ** 2 + errors[i, 1] ** 2
        one, other = rows[0], rows[1]
        for k in range(size):
            a, b = one[k], other[k]
            right[k] -= a * errors[i, 0] + b * errors[i, 1]
            below = matrix[k]
            for j in range(k + 1):
                below[j] += a * one[j] + b * other[j]
    for k in range(size):
        for j in range(k):
            matrix[j, k] = matrix[k, j]
    return Products(matrix, right, square)


@inlined
def _fill(row: Array, by_motion: Array, by_turn: Array, values: Array, turns: bool) -> None:
    for k in range(PARAMETERS):
        row[k] = by_motion[k]
    if turns:
        for k in range(FUNCTIONS):
            for axis in range(3):
                row[PARAMETERS + 3 * k + axis] = values[k] * by_turn[axis]


@inlined
def _fill_bend(row: Array, by_motion: Array, bend: Array) -> None:
    """A point of the map that moves along an axis of the camera is a camera that moves back."""
    for k in range(len(bend)):
        for axis in range(3):
            row[3 * k + axis] = -by_motion[3 + axis] * bend[k]


@inlined
def smooth_size(bend: Array) -> int:
    """Number of coefficients of the smooth error."""
    return 3 * bend.shape[1] if bend.shape[1] > 0 else 2 * SMOOTH_TERMS


@kernel
def extent(lines: Lines, inliers: BoolArray) -> tuple[Array, Array]:
    """Least and largest coordinates (2,) of the image that the inliers fill."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for i in range(len(inliers)):
        if inliers[i]:
            for k in range(2):
                low[k] = min(low[k], lines.image[i, k])
                high[k] = max(high[k], lines.image[i, k])
    return low, high


@kernel
def smooth_terms(image: Array, low: Array, high: Array, terms: Array) -> None:
    x, y = np.empty(SMOOTH_DEGREE + 1), np.empty(SMOOTH_DEGREE + 1)
    x[0], y[0] = 1.0, 1.0
    x[1] = (2.0 * image[0] - low[0] - high[0]) / max(high[0] - low[0], 1e-12)
    y[1] = (2.0 * image[1] - low[1] - high[1]) / max(high[1] - low[1], 1e-12)
    for k in range(2, SMOOTH_DEGREE + 1):  # Legendre
        x[k] = ((2 * k - 1) * x[1] * x[k - 1] - (k - 1) * x[k - 2]) / k
        y[k] = ((2 * k - 1) * y[1] * y[k - 1] - (k - 1) * y[k - 2]) / k
    place = 0
    for degree in range(SMOOTH_DEGREE + 1):
        for i in range(degree + 1):
            terms[place] = x[i] * y[degree - i] * _TERM_SIZES[place]
            place += 1


@kernel
def smooth_at(lines: Lines, inliers: BoolArray, coefficients: Array, bend: Array) -> Array:
    """The smooth error (n,2) px at all points, of coefficients (20,), or (3 b,) of a bent map."""
    row = np.empty(len(coefficients))
    low, high = extent(lines, inliers)
    terms, shown = np.zeros(SMOOTH_TERMS), np.zeros((len(inliers), 2))
    for i in range(len(inliers)):
        if bend.shape[1] == 0:
            smooth_terms(lines.image[i], low, high, terms)
        for side in range(2):
            total = 0.0
            if bend.shape[1] > 0:
                _fill_bend(row, lines.by_motion[i, side], bend[i])
                for k in range(len(row)):
                    total += row[k] * coefficients[k]
            else:
                for k in range(SMOOTH_TERMS):
                    total += terms[k] * coefficients[SMOOTH_TERMS * side + k]
            shown[i, side] = total
    return shown


def bend_of(points: Array, inliers: BoolArray, declared: float, size: float) -> Array:
    """Functions (n,b) of the points' places; ``size``: m, their root mean square, all together."""
    sizes = _BENT_SIZES if declared > 0.0 else DEGREE_SIZES
    chosen = points[inliers]
    low, high = chosen.min(axis=0), chosen.max(axis=0)
    places = (points - 0.5 * (low + high)) / max(0.5 * float(np.max(high - low)), _LEAST_EXTENT)
    x, y, z = (legvander(places[:, k], len(sizes) - 1) for k in range(3))
    bend = np.column_stack([
        of_degree * math.sqrt((2 * i + 1) * (2 * j + 1) * (2 * (degree - i - j) + 1))
        * x[:, i] * y[:, j] * z[:, degree - i - j]
        for degree, of_degree in enumerate(sizes)
        for i in range(degree + 1)
        for j in range(degree + 1 - i)
    ])  # fmt: skip
    # On a plane they repeat each other.
    values, axes = np.linalg.eigh(bend[inliers].T @ bend[inliers])
    total = np.sum(values)
    size *= math.sqrt(np.count_nonzero(inliers) / total)
    combined: Array = size * bend @ axes[:, values > _LEAST_BEND**2 * total]
    return combined


@kernel
def full_prior(
    prior: PriorTerms, state: Array, turns: Array, size: int
) -> tuple[Array, Array, float]:
    """Information (m,m), slope (m,) and cost of the prior of the motion, for all columns.

    It is the prior of the motion without the in-frame turn, of which value and slope at the middle
    row stand in the state, ``x_without = x - G c``: coefficients (28,3) of the turn take part.
    """
    information, slope = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    # G: by how much each function of the row time turns the middle row, and how fast (m,).
    values, rates = MIDDLE_VALUES, MIDDLE_RATES
    step = np.zeros(PARAMETERS)
    for k in range(len(turns)):
        for axis in range(3):
            step[axis] -= values[k] * turns[k, axis]
            step[6 + axis] -= rates[k] * turns[k, axis]
    cost = add_prior(prior, apply_step(state, step), 1.0, information, slope)
    whole, along = np.zeros((size, size)), np.zeros(size)
    whole[:PARAMETERS, :PARAMETERS] = information
    along[:PARAMETERS] = slope
    for k in range(len(turns)):
        for axis in range(3):
            i = PARAMETERS + 3 * k + axis
            along[i] = -values[k] * slope[axis] - rates[k] * slope[6 + axis]
            for j in range(PARAMETERS):
                pull = -values[k] * information[axis, j] - rates[k] * information[6 + axis, j]
                whole[i, j] = whole[j, i] = pull
    for k in range(len(turns)):
        for axis in range(3):
            i = PARAMETERS + 3 * k + axis
            for j in range(PARAMETERS, PARAMETERS + 3 * len(turns)):
                whole[j, i] = -values[k] * whole[j, axis] - rates[k] * whole[j, 6 + axis]
    return whole, along, cost


class _Solved(NamedTuple):
    values: Array  # (m,) step of the motion, and all coefficients anew
    covariance: Array  # (m,m)
    log_scales: Array  # (15,)
    decided: Array  # (15,)
    freedom: float
    left: float  # px^2, squared errors beside all
    prior_cost: float  # of the coefficients
    log_determinant: float  # of the covariance over that of the prior of the coefficients


@kernel
def with_scales(
    normal: Products, information: Array, slope: Array, coefficients: Array, log_scales: Array,
    hyper_mean: Array, hyper_precision: Array, noise: float, equations: int, rounds: int,
) -> _Solved:  # fmt: skip
    """Solve for motion and coefficients, and re-estimate the scales, in turns.

    The motion has no scale: it is taken out first (Schur complement), once for all rounds.

    Args:
        normal: of the errors linearized about the coefficients (q,).
        information, slope: of the prior of the motion, for all columns (m,m), (m,).
        log_scales, hyper_mean, hyper_precision: (15,).
        noise: px, which the caller measures.
        equations: number of errors.
        rounds: of solving, at most; the scales of the last one are those of the covariance.
    """
    size, variance = len(normal.with_errors), noise * noise
    q = size - PARAMETERS
    groups = _groups(q)
    matrix = normal.products / variance + information
    # Errors as functions of new values, not of changes.
    right = np.empty(size)
    for i in range(size):
        matrix[i, i] *= _RIDGE
        total = normal.with_errors[i] / variance - slope[i]
        for k in range(q):
            total += matrix[i, PARAMETERS + k] * coefficients[k]
        right[i] = total
    of_motion, scale_of_motion, determined = half_inverse(matrix[:PARAMETERS, :PARAMETERS].copy())
    for i in range(PARAMETERS):
        for j in range(i + 1):
            of_motion[i, j] *= scale_of_motion[j]
    beside, of_coefficients, along = _without_motion(matrix, right, of_motion)
    scales, decided, uphill = log_scales.copy(), np.zeros(SCALES), np.zeros(SCALES)
    best, spread = np.zeros(q), np.zeros(q)
    active, half, unit = np.zeros(0, np.int64), np.zeros((0, 0)), np.zeros(0)
    positive, before = True, np.zeros(SCALES)
    for turn in range(rounds):
        active = _active(normal.products, scales, groups, variance)
        half, unit, positive = half_inverse(
            _with_precisions(of_coefficients, scales, groups, active)
        )
        _solve(half, unit, along, active, best, spread)
        _slope_of_scales(best, spread, active, groups, scales, decided, uphill)
        if turn == rounds - 1:
            break
        step = _climb(scales, uphill, decided, hyper_mean, hyper_precision)
        if np.max(np.abs(step)) < _SETTLED:
            break
        if turn % 2 == 1:
            _extrapolate(step, before)
        scales, before = scales + step, step
    covariance, values = _joint(of_motion, beside, half, unit, active, right, best)
    logarithms = scales[groups]
    volume = _volume(of_motion, half, unit) - 2.0 * np.sum(logarithms[active])
    cost = np.sum(values[PARAMETERS:] ** 2 * np.exp(-2.0 * logarithms))
    change = values.copy()
    change[PARAMETERS:] -= coefficients
    for k in range(q):
        if covariance[PARAMETERS + k, PARAMETERS + k] == 0.0:  # not active: as the prior has it
            covariance[PARAMETERS + k, PARAMETERS + k] = math.exp(2.0 * logarithms[k])
    left, used = _left(normal, change, covariance)
    freedom = max(equations - used / variance, 1.0)
    if not (determined and positive):
        values[:], covariance[:] = np.nan, np.nan
    return _Solved(values, covariance, scales, decided, freedom, max(left, 0.0), cost, volume)


@inlined
def _without_motion(
    matrix: Array, right: Array, of_motion: Array
) -> tuple[Array, Array, Array]:  # fmt: skip
    """The information (q,q) and right side (q,) of the coefficients, whatever the motion.

    And first what takes it out: the products (18,q) of the motion with the coefficients, behind
    ``of_motion``, the half inverse (18,18) of the motion's own.
    """
    q = len(right) - PARAMETERS
    beside, whitened = np.zeros((PARAMETERS, q)), np.zeros(PARAMETERS)
    information, along = matrix[PARAMETERS:, PARAMETERS:].copy(), right[PARAMETERS:].copy()
    for a in range(PARAMETERS):
        own = beside[a]
        for b in range(a + 1):
            factor, row = of_motion[a, b], matrix[b]
            whitened[a] += factor * right[b]
            for k in range(q):
                own[k] += factor * row[PARAMETERS + k]
        for k in range(q):
            factor, row = own[k], information[k]
            along[k] -= factor * whitened[a]
            for j in range(k + 1):
                row[j] -= factor * own[j]
    return beside, information, along


@inlined
def _with_precisions(
    information: Array, scales: Array, groups: IntArray, active: IntArray
) -> Array:
    """Information of the active coefficients, the prior's included; the lower triangle."""
    count = len(active)
    matrix = np.empty((count, count))
    for a in range(count):
        i = active[a]
        for b in range(a + 1):
            matrix[a, b] = information[i, active[b]]
        matrix[a, a] += math.exp(-2.0 * scales[groups[i]])
    return matrix


@inlined
def _solve(
    half: Array, unit: Array, along: Array, active: IntArray, best: Array, spread: Array
) -> None:
    """Fill in the best coefficients and their variances, (q,) each, of the active ones."""
    best[:], spread[:] = 0.0, 0.0
    values, squares = np.zeros(len(active)), np.zeros(len(active))
    for a in range(len(active)):
        row, total = half[a], 0.0
        for b in range(a + 1):
            total += row[b] * unit[b] * along[active[b]]
        for b in range(a + 1):
            values[b] += row[b] * total
            squares[b] += row[b] * row[b]
    for a in range(len(active)):
        best[active[a]] = unit[a] * values[a]
        spread[active[a]] = unit[a] * unit[a] * squares[a]


@inlined
def _joint(
    of_motion: Array, beside: Array, half: Array, unit: Array, active: IntArray, right: Array,
    best: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Covariance (m,m) of motion and coefficients, and their values (m,)."""
    q, count = len(best), len(active)
    covariance, values = np.zeros((PARAMETERS + q, PARAMETERS + q)), np.zeros(PARAMETERS + q)
    inverse, pull = squared(half, unit), np.zeros((PARAMETERS, count))
    whitened = np.zeros(PARAMETERS)
    for a in range(PARAMETERS):
        total = 0.0
        for b in range(a + 1):
            total += of_motion[a, b] * right[b]
        for k in range(count):
            total -= beside[a, active[k]] * best[active[k]]
        whitened[a] = total
    for a in range(PARAMETERS):
        for b in range(a + 1):
            values[b] += of_motion[a, b] * whitened[a]
            for k in range(count):  # by how much a coefficient moves the motion
                pull[b, k] -= of_motion[a, b] * beside[a, active[k]]
    pulled = _multiplied(pull, inverse)
    for i in range(PARAMETERS):
        for j in range(PARAMETERS):
            total = 0.0
            for a in range(max(i, j), PARAMETERS):
                total += of_motion[a, i] * of_motion[a, j]
            for k in range(count):
                total += pulled[i, k] * pull[j, k]
            covariance[i, j] = total
        for k in range(count):
            covariance[i, PARAMETERS + active[k]] = pulled[i, k]
            covariance[PARAMETERS + active[k], i] = pulled[i, k]
    for a in range(count):
        values[PARAMETERS + active[a]] = best[active[a]]
        for b in range(count):
            covariance[PARAMETERS + active[a], PARAMETERS + active[b]] = inverse[a, b]
    return covariance, values


@inlined
def _volume(of_motion: Array, half: Array, unit: Array) -> float:
    """Logarithm of the determinant of the covariance of motion and coefficients."""
    volume = 0.0
    for i in range(PARAMETERS):
        volume += 2.0 * math.log(of_motion[i, i])
    for a in range(len(unit)):
        volume += 2.0 * math.log(half[a, a] * unit[a])
    return volume


@inlined
def _left(normal: Products, change: Array, covariance: Array) -> tuple[float, float]:
    """Squared errors (px^2) after a change (m,), and the trace of covariance times products."""
    left, used = normal.squared_errors, 0.0
    for i in range(len(change)):
        left -= 2.0 * change[i] * normal.with_errors[i]
        for j in range(len(change)):
            left += change[i] * normal.products[i, j] * change[j]
            used += covariance[i, j] * normal.products[i, j]
    return left, used


@inlined
def _groups(coefficients: int) -> IntArray:
    """Which scale each of the coefficients has (q,)."""
    groups = np.full(coefficients, SCALES - 1, np.int64)
    if coefficients >= TURNS:
        for k in range(TURNS):
            groups[k] = k // 6
    return groups


@inlined
def _active(products: Array, scales: Array, groups: IntArray, variance: float) -> IntArray:
    """Coefficients that can move a point by more than a small part of the noise."""
    active, count = np.empty(len(groups), dtype=np.int64), 0
    for k in range(len(groups)):
        i = PARAMETERS + k
        moves = math.exp(2.0 * scales[groups[k]]) * products[i, i]
        if moves > _NEGLIGIBLE * _NEGLIGIBLE * variance:
            active[count] = k
            count += 1
    return active[:count].copy()


@inlined
def _climb(
    scales: Array, uphill: Array, decided: Array, hyper_mean: Array, hyper_precision: Array
) -> Array:
    """Newton's step (15,) of the log-scales, each held to be short."""
    steps = np.empty(SCALES)
    for g in range(SCALES):
        climb = uphill[g] - hyper_precision[g] * (scales[g] - hyper_mean[g])
        bend = 2.0 * decided[g] + hyper_precision[g]
        for other in (g - 1, g + 1):
            if g < SCALES - 1 and 0 <= other < SCALES - 1:
                climb -= _SMOOTH_SPECTRUM * (scales[g] - scales[other])
                bend += _SMOOTH_SPECTRUM
        step = min(max(climb / (bend + TINY), -_LONGEST_SCALE_STEP), _LONGEST_SCALE_STEP)
        steps[g] = min(max(scales[g] + step, _LEAST_LOG_SCALE), _MOST_LOG_SCALE) - scales[g]
    return steps


@inlined
def _extrapolate(steps: Array, before: Array) -> None:
    """Lengthen steps (15,) by what the ratios to the steps before foresee (Aitken 1926)."""
    for g in range(SCALES):
        ratio = steps[g] / before[g] if before[g] != 0.0 else 0.0
        if ratio > 0.0:
            steps[g] *= min(1.0 / max(1.0 - ratio, TINY), _FARTHEST)


@inlined
def _slope_of_scales(
    best: Array, spread: Array, active: IntArray, groups: IntArray, scales: Array, decided: Array,
    uphill: Array,
) -> None:  # fmt: skip
    """Fill in the slope (15,) of the log evidence by each log-scale: squares in deviations, less
    how many coefficients of each scale the points decide (MacKay's gamma), filled in, too.
    """
    for g in range(SCALES):
        precision, squares, known = math.exp(-2.0 * scales[g]), 0.0, 0.0
        for k in active:
            if groups[k] == g:
                squares += best[k] * best[k] * precision
                known += 1.0 - spread[k] * precision
        decided[g] = max(known, 0.0)
        uphill[g] = squares - decided[g]


@inlined
def _multiplied(left: Array, right: Array) -> Array:
    """Matrix product, row by row."""
    product = np.zeros((len(left), right.shape[1]))
    for i in range(len(left)):
        row = product[i]
        for k in range(len(right)):
            factor, other = left[i, k], right[k]
            for j in range(len(other)):
                row[j] += factor * other[j]
    return product


@kernel
def log_determinant_of_inverse(matrix: Array) -> float:
    """Logarithm of the determinant of a covariance."""
    size = len(matrix)
    factor, total = np.zeros((size, size)), 0.0
    for i in range(size):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= factor[i, k] * factor[j, k]
            if i == j:
                rest = max(rest, 1e-15 * matrix[i, i])
                total += math.log(rest)
                factor[i, i] = math.sqrt(rest)
            else:
                factor[i, j] = rest / factor[j, j]
    return total


@inlined
def _row_times(data: Array, count: int) -> Array:
    """Measured row times (n,) of packed points."""
    lanes = data.shape[1] // POINT_SIZE
    tau = np.empty(count)
    for i in range(count):
        tau[i] = data[i // lanes, 5 * lanes + i % lanes]
    return tau


@kernel
def fit_frame(
    data: Array, count: int, start: Array, prior: PriorTerms, threshold: float,
    first_gate: float, first_noise: float, log_scales: Array, hyper_mean: Array,
    hyper_precision: Array, with_turns: bool, with_smooth: bool, bend: Array, most: int,
) -> FrameFit:  # fmt: skip
    """Fit motion, in-frame turn, smooth error, their scales, the noise and the inliers.

    Args:
        data: packed points, ``count`` of them.
        start: state (24,).
        prior: of the motion without its in-frame turn.
        threshold: px, of inliers.
        first_gate, first_noise: px; the gate closes from there to what the noise decides.
        log_scales, hyper_mean, hyper_precision: (15,) where the logarithms of the scales start, and
            what is known of them.
        with_turns, with_smooth: whether there is an in-frame turn, a smooth error.
        bend: (n,b) functions of the points' places in the map, of which the smooth error is a
            combination for each axis of the camera (m); (n,0): it is one of the image.
        most: steps.
    """
    q = (TURNS if with_turns else 0) + (smooth_size(bend) if with_smooth else 0)
    size, first = PARAMETERS + q, TURNS if with_turns else 0
    state, coefficients = start.copy(), np.zeros(q)
    gate, noise, scales = first_gate, first_noise, log_scales.copy()
    solved = _Solved(
        np.zeros(size), np.zeros((size, size)), scales, np.zeros(SCALES), 0.0, 0.0, 0.0, 0.0
    )
    tau = _row_times(data, count)
    turns = np.zeros((FUNCTIONS if with_turns else 0, 3))
    inliers = squared_errors(data, count, state) < gate * gate
    finite, done, groups = True, False, _groups(q)
    lines = linearized(data, count, state, shake_at(tau, turns))
    errors, squared = _beside(data, state, lines, inliers, coefficients[first:], bend)
    information, slope, prior_cost = full_prior(prior, state, turns, size)
    for turn in range(most):
        kept = int(np.count_nonzero(inliers))
        if kept < _FEWEST:
            finite = False
            break
        normal = products_of(lines, inliers, errors, with_turns, with_smooth, bend)
        solved = with_scales(
            normal, information, slope, coefficients, scales, hyper_mean, hyper_precision, noise,
            2 * kept, (_SCALE_ROUNDS if turn < 3 else _LATER_SCALE_ROUNDS) if q > 0 else 1,
        )  # fmt: skip
        step, scales = solved.values.copy(), solved.log_scales
        step[PARAMETERS:] -= coefficients
        moved = _largest_move(step, solved.covariance)
        if not np.isfinite(moved):
            finite = False
            break
        precisions, origin, before = np.exp(-2.0 * scales[groups]), state, coefficients
        most_cost = prior_cost + np.sum(before**2 * precisions)
        most_cost += np.sum(squared[inliers]) / noise**2 + _SHORT
        # What hardly determines a velocity is a valley that bends: a full step may leave it.
        for _ in range(_HALVINGS):
            state, coefficients = apply_step(origin, step[:PARAMETERS]), before + step[PARAMETERS:]
            for k in range(len(turns)):
                for axis in range(3):
                    turns[k, axis] = coefficients[3 * k + axis]
            lines = linearized(data, count, state, shake_at(tau, turns))
            errors, squared = _beside(data, state, lines, inliers, coefficients[first:], bend)
            information, slope, prior_cost = full_prior(prior, state, turns, size)
            cost = prior_cost + np.sum(coefficients**2 * precisions)
            if cost + np.sum(squared[inliers]) / noise**2 <= most_cost:
                break
            step *= 0.5
        noise = noise_deviation(squared, gate, max(2.0 * kept - solved.freedom, 0.0))
        closed = gate <= WIDEST_GATE * threshold
        gate = max(_CLOSING * gate, min(max(threshold, GATE * noise), WIDEST_GATE * threshold))
        inliers = squared < gate * gate
        if done or (closed and moved < _SHORT):
            if done:
                break
            done = True
    variance, chosen = noise * noise, PARAMETERS + first
    left = np.sum(squared[inliers]) / variance
    prior_cost += np.sum(coefficients**2 * np.exp(-2.0 * scales[groups]))
    scale_cost, volume, spread = _of_scales(
        scales - hyper_mean, scales, hyper_precision, solved.decided,
        0 if with_turns else SCALES - 1, SCALES if with_smooth else SCALES - 1,
    )  # fmt: skip
    prior_cost, log_determinant = prior_cost + scale_cost, solved.log_determinant + volume
    kept = int(np.count_nonzero(inliers))
    evidence = 0.5 * (log_determinant - left - prior_cost) - kept * math.log(variance)
    smooth = math.exp(scales[SCALES - 1]) if with_smooth else 0.0
    agreement = neighbours_agree(errors, tau, lines.image, inliers)
    finite = finite and bool(np.all(np.isfinite(solved.covariance)))
    by_smooth = solved.covariance[:chosen, chosen:] / max(smooth, TINY)
    own = solved.covariance[:chosen, :chosen] - by_smooth @ by_smooth.T
    if with_turns:
        own += _by_scales(solved.covariance[:chosen], coefficients, scales, groups, spread)
    return FrameFit(
        state, turns, own, by_smooth, noise, solved.freedom, inliers, squared, scales,
        solved.decided, smooth, agreement, evidence,
        left, prior_cost, log_determinant, finite,
    )  # fmt: skip


@kernel
def at_speed(
    state: Array, turns: Array, covariance: Array, by_smooth: Array, freedom: float,
    terms: PriorTerms, speed: float, turn_known: bool,
) -> tuple[Array, Array, Array, float]:  # fmt: skip
    """A fit under the prior of a slower motion: state, turns and covariance; and by how much the
    logarithm of the evidence changes.

    Near the fit all is linear, and what is known better are the velocities and accelerations of the
    motion without its in-frame turn: that each is zero, one after the other (Kalman 1960). Inliers
    and scales stay, where those of a fit of its own would grow, so that rest has less evidence than
    such a fit gives it in some frames; the noise is unknown (Student's form).

    Args:
        state, turns, covariance, by_smooth: (24,), (28,3), (18 + 84,18 + 84), (18 + 84,q).
        freedom: of the errors.
        terms: of the fit.
        speed: part of the configured one.
    """
    before, after = terms.informations[0], terms_at(terms, speed, turn_known).informations[0]
    size, moved = len(covariance), by_smooth.copy()
    covariance = covariance + moved @ moved.T
    step, squared, volume = np.zeros(size), 0.0, 0.0
    for k in range(POSE.stop, PARAMETERS):
        known, more = before[k, k], after[k, k] - before[k, k]
        if not (known > 0.0 and more > 0.0):
            continue
        value, pulled, by = state[6 + k] + step[k], covariance[k].copy(), moved[k].copy()
        waves = k < ANGULAR.stop
        for j in range(1, FUNCTIONS if waves else 0, 2):  # of the sines
            axis = k - ANGULAR.start
            place = PARAMETERS + 3 * j + axis
            value -= MIDDLE_RATES[j] * (turns[j, axis] + step[place])
            pulled -= MIDDLE_RATES[j] * covariance[place]
            by -= MIDDLE_RATES[j] * moved[place]
        variance = 1.0 / more + pulled[k]
        for j in range(1, FUNCTIONS if waves else 0, 2):
            variance -= MIDDLE_RATES[j] * pulled[PARAMETERS + 3 * j + k - ANGULAR.start]
        for i in range(size):
            part = pulled[i] / variance
            step[i] -= part * value
            covariance[i] -= part * pulled
            moved[i] -= part * by
        squared += value * value / variance
        volume += math.log(variance * known * more / after[k, k])
    freedom = max(freedom, 6.0)
    ratio = -0.5 * (freedom * math.log1p(squared / freedom) + volume)
    return (
        apply_step(state, step[:PARAMETERS]), turns + step[PARAMETERS:].copy().reshape(turns.shape),
        covariance - moved @ moved.T, ratio,
    )  # fmt: skip


@inlined
def _of_scales(
    away: Array, scales: Array, precision: Array, decided: Array, first: int, last: int
) -> tuple[float, float, Array]:
    """Cost of the log-scales from ``first`` to before ``last``, ``away`` from what is known of
    them, the logarithm of the determinant of their covariance over that of their hyperprior
    (Laplace), as modes and frames with an in-frame turn are not equally probable in them, and that
    covariance.
    """
    count, cost = last - first, 0.0
    before = np.zeros((count, count))
    for i in range(count):
        g = first + i
        cost += precision[g] * away[g] ** 2
        before[i, i] += precision[g]
        if i > 0 and g < SCALES - 1:
            cost += _SMOOTH_SPECTRUM * (scales[g] - scales[g - 1]) ** 2
            for j in (i - 1, i):
                before[j, j] += _SMOOTH_SPECTRUM
                before[j, 2 * i - 1 - j] -= _SMOOTH_SPECTRUM
    after = before.copy()
    for i in range(count):
        after[i, i] += 2.0 * decided[first + i]
    volume = log_determinant_of_inverse(before) - log_determinant_of_inverse(after)
    return cost, volume, inverted(after)


@inlined
def _by_scales(
    covariance: Array, coefficients: Array, scales: Array, groups: IntArray, spread: Array
) -> Array:
    """Covariance (p,p) of motion and turn from not knowing the log-scales of the turn, of
    covariance ``spread`` (Kass, Steffey, JASA 84, 1989), from theirs with all (p,m).
    """
    by_scale = np.zeros((len(covariance), SCALES - 1))
    for k in range(TURNS):
        g = groups[k]
        pull = 2.0 * math.exp(-2.0 * scales[g]) * coefficients[k]
        for i in range(len(covariance)):
            by_scale[i, g] += pull * covariance[i, PARAMETERS + k]
    of_turn = np.ascontiguousarray(spread[: SCALES - 1, : SCALES - 1])
    return by_scale @ of_turn @ by_scale.T


@kernel
def _beside(
    data: Array,
    state: Array,
    lines: Lines,
    inliers: BoolArray,
    smooth: Array,
    bend: Array,
) -> tuple[Array, Array]:
    """Errors (n,2) beside the smooth one, and their squares (n,); infinite behind the camera."""
    errors = lines.errors.copy()
    if len(smooth) > 0:
        errors += smooth_at(lines, inliers, smooth, bend)
    squared = squared_errors(data, len(errors), state)
    for i in range(len(errors)):
        if np.isfinite(squared[i]):
            squared[i] = errors[i, 0] ** 2 + errors[i, 1] ** 2
    return errors, squared


@inlined
def _largest_move(step: Array, covariance: Array) -> float:
    """Square of the longest part of a step, in deviations; NaN where one is not finite."""
    longest = 0.0
    for i in range(len(step)):
        part = step[i] * step[i] / max(covariance[i, i], TINY)
        if not part <= longest:
            longest = part
    return longest


@kernel
def neighbours_agree(errors: Array, tau: Array, rays: Array, inliers: BoolArray) -> float:
    """How much the errors of points in neighbouring rows agree: standard normal if they do not.

    Neighbours in the image do not count: corners of one marker share errors whatever the camera
    does.
    """
    order = np.argsort(tau)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    squared, count = 0.0, 0
    for i in order:
        if inliers[i]:
            squared += errors[i, 0] ** 2 + errors[i, 1] ** 2
            count += 1
            for k in range(2):
                low[k], high[k] = min(low[k], rays[i, k]), max(high[k], rays[i, k])
    if count < 2 or not squared > 0.0:
        return 0.0
    far = _FAR_APART * max(high[0] - low[0], high[1] - low[1])
    agreement, pairs = 0.0, 0
    previous = -1
    for i in order:
        if not inliers[i]:
            continue
        if previous >= 0:
            x, y = rays[i, 0] - rays[previous, 0], rays[i, 1] - rays[previous, 1]
            if x * x + y * y > far * far:
                pairs += 1
                agreement += errors[previous, 0] * errors[i, 0] + errors[previous, 1] * errors[i, 1]
        previous = i
    # Each of the two products of a pair has the square of the mean square as its variance.
    variance = max(0.5 * squared / count, LEAST_NOISE * LEAST_NOISE)
    normalized: float = agreement / (variance * np.sqrt(2.0 * max(pairs, 1)))
    return normalized
