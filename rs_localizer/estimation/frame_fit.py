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

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.scales import SCALES
from rs_localizer.core.shake import FUNCTIONS, RATES, shake_at, shake_basis
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.posterior import GATE, WIDEST_GATE, noise_deviation
from rs_localizer.estimation.prior_kernels import add_prior
from rs_localizer.estimation.prior_terms import PriorTerms
from rs_localizer.estimation.refine import apply_step, inverted
from rs_localizer.estimation.residual_tests import neighbours_agree
from rs_localizer.estimation.residuals import Lines, linearized, squared_errors
from rs_localizer.estimation.view import POINT_SIZE

SMOOTH_DEGREE = 3
SMOOTH_TERMS = (SMOOTH_DEGREE + 1) * (SMOOTH_DEGREE + 2) // 2
TURNS = 3 * FUNCTIONS
# Expected size of each degree: printers stretch paper, lenses bend at the rim; the mean square
# over the image of a field of scale 1 is 1.
_DEGREE_SIZES = (1.0, 1.0, 0.5, 0.25)
_TERM_SIZES = np.array(
    [
        _DEGREE_SIZES[degree] * math.sqrt((2 * i + 1) * (2 * (degree - i) + 1))
        for degree in range(SMOOTH_DEGREE + 1)
        for i in range(degree + 1)
    ]
) / math.sqrt(sum((d + 1) * size**2 for d, size in enumerate(_DEGREE_SIZES)))
# A column whose scale moves no point by this part of the noise is left out: it changes nothing.
_NEGLIGIBLE = 0.03
# Neighbouring frequencies have scales alike to a factor of e (precision of the difference of their
# logarithms): what one readout shows of a tone leaks into those beside it (Rayleigh).
_SMOOTH_SPECTRUM = 1.0
# Newton's steps of a log-scale are held to a factor of e.
_LONGEST_SCALE_STEP = 1.0
# Logarithms of scales stay within these: 1e-6 rad is a thousandth of a pixel at f = 1000.
_LEAST_LOG_SCALE, _MOST_LOG_SCALE = math.log(1e-6), math.log(30.0)
# Rounds of scales in the first steps, in which the gate closes, and in those that follow.
_SCALE_ROUNDS, _LATER_SCALE_ROUNDS = 12, 4
# Of the diagonal: what nothing determines has an inverse.
_RIDGE = 1.0 + 1e-13
# The gate closes by this factor from step to step (graduated non-convexity).
_CLOSING = 0.6
# A last step this short, in squared standard deviations: the next one is its square.
_SHORT = 1e-3
# Fewer inliers determine nothing.
_FEWEST = 6
_TINY = 1e-300


class Products(NamedTuple):
    """Products of all columns over the inliers: motion, in-frame turn, smooth error."""

    products: Array  # (m,m)
    with_errors: Array  # (m,) with the negative errors
    squared_errors: float  # px^2


class FrameFit(NamedTuple):
    """A mode of the posterior of a frame: the Laplace approximation about an optimum."""

    state: Array  # (24,)
    turns: Array  # (28,3) rad, coefficients of the in-frame turn; zeros without one
    covariance: Array  # (18 + 84,18 + 84), or (18,18) without an in-frame turn
    noise: float  # px
    freedom: float
    inliers: BoolArray  # (n,)
    squared_errors: Array  # (n,) px^2, beside the in-frame turn and the smooth error
    log_scales: Array  # (15,)
    decided: Array  # (15,) how many coefficients of each scale the points decide
    smooth: float  # px, scale of the smooth error: its expected root mean square
    agreement: float  # of neighbouring rows (see residual_tests)
    evidence: float  # logarithm, but for a constant of the inliers
    left: float  # squared errors beside all, in variances of the noise
    prior_cost: float  # of motion and coefficients
    log_determinant: float  # of the covariance over that of the prior of the coefficients
    finite: bool


@kernel
def products_of(
    lines: Lines, inliers: BoolArray, errors: Array, turns: bool, smooth: bool
) -> Products:
    """Multiply the columns of the inliers with each other and with their errors (n,2)."""
    first = PARAMETERS + (TURNS if turns else 0)
    size = first + (2 * SMOOTH_TERMS if smooth else 0)
    matrix, right, square = np.zeros((size, size)), np.zeros(size), 0.0
    low, high = extent(lines, inliers)
    values, rates, terms = np.empty(FUNCTIONS), np.empty(FUNCTIONS), np.zeros(SMOOTH_TERMS)
    rows = np.zeros((2, size))
    for i in range(len(inliers)):
        if not inliers[i]:
            continue
        if turns:
            shake_basis(lines.tau[i], values, rates)
        if smooth:
            smooth_terms(lines.image[i], low, high, terms)
        for side in range(2):
            _fill(rows[side], lines.by_motion[i, side], lines.by_turn[i, side], values, turns)
            if smooth:
                rows[side, first + SMOOTH_TERMS * side : first + SMOOTH_TERMS * (side + 1)] = terms
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
def smooth_at(lines: Lines, inliers: BoolArray, coefficients: Array) -> Array:
    """The smooth error (n,2) px at all points, of coefficients (20,)."""
    low, high = extent(lines, inliers)
    terms, shown = np.zeros(SMOOTH_TERMS), np.zeros((len(inliers), 2))
    for i in range(len(inliers)):
        smooth_terms(lines.image[i], low, high, terms)
        for side in range(2):
            total = 0.0
            for k in range(SMOOTH_TERMS):
                total += terms[k] * coefficients[SMOOTH_TERMS * side + k]
            shown[i, side] = total
    return shown


@kernel
def full_prior(
    prior: PriorTerms, state: Array, turns: Array, size: int
) -> tuple[Array, Array, float]:
    """Information (m,m), slope (m,) and cost of the prior of the motion, for all columns.

    It is the prior of the motion without the in-frame turn, of which value and slope at the middle
    row stand in the state, ``x_without = x - G c``: coefficients (28,3) of the turn take part.
    """
    information, slope = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    # Row of x and its derivative by each coefficient: -1 and -rate.
    places, factors = np.empty(3 * len(turns), np.int64), np.empty(3 * len(turns))
    step = np.zeros(PARAMETERS)
    for k in range(len(turns)):
        for axis in range(3):
            places[3 * k + axis] = axis if k % 2 == 0 else 6 + axis
            factors[3 * k + axis] = -1.0 if k % 2 == 0 else -RATES[k // 2]
            step[places[3 * k + axis]] += factors[3 * k + axis] * turns[k, axis]
    cost = add_prior(
        prior.informations, prior.references, prior.gravity, apply_step(state, step), 1.0,
        information, slope,
    )  # fmt: skip
    whole, along = np.zeros((size, size)), np.zeros(size)
    whole[:PARAMETERS, :PARAMETERS] = information
    along[:PARAMETERS] = slope
    for a in range(len(places)):
        i = PARAMETERS + a
        along[i] = factors[a] * slope[places[a]]
        for j in range(PARAMETERS):
            whole[i, j] = factors[a] * information[places[a], j]
            whole[j, i] = whole[i, j]
        for b in range(len(places)):
            whole[i, PARAMETERS + b] = factors[a] * factors[b] * information[places[a], places[b]]
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

    Args:
        normal: of the errors linearized about the coefficients (q,).
        information, slope: of the prior of the motion, for all columns (m,m), (m,).
        log_scales, hyper_mean, hyper_precision: (15,).
        noise: px, which the caller measures.
        equations: number of errors.
        rounds: of solving; the scales of the last one are those of the covariance.
    """
    size, variance = len(normal.with_errors), noise * noise
    q = size - PARAMETERS
    groups = _groups(q)
    scales, decided = log_scales.copy(), np.zeros(SCALES)
    # Errors as functions of new values, not of changes.
    right = np.empty(size)
    for i in range(size):
        total = normal.with_errors[i] / variance - slope[i]
        for k in range(q):
            pull = normal.products[i, PARAMETERS + k] / variance + information[i, PARAMETERS + k]
            total += pull * coefficients[k]
        right[i] = total
    values, active, inverse = np.zeros(size), np.zeros(0, np.int64), np.zeros((0, 0))
    for turn in range(rounds):
        active = _active(normal.products, scales, groups, variance)
        inverse = _inverse_of(normal.products, information, scales, groups, active, variance)
        values[:] = 0.0
        for a in range(len(active)):
            total = 0.0
            for b in range(len(active)):
                total += inverse[a, b] * right[active[b]]
            values[active[a]] = total
        uphill = _slope_of_scales(values, inverse, active, groups, scales, decided)
        if turn < rounds - 1:
            _climb(scales, uphill, decided, hyper_mean, hyper_precision)
    covariance = np.zeros((size, size))
    volume = log_determinant_of_inverse(inverse)
    for a in range(len(active)):
        for b in range(len(active)):
            covariance[active[a], active[b]] = inverse[a, b]
        if active[a] >= PARAMETERS:
            volume -= 2.0 * scales[groups[active[a] - PARAMETERS]]
    left, used, cost = normal.squared_errors, 0.0, 0.0
    change, precisions = values.copy(), np.empty(q)
    for k in range(q):
        change[PARAMETERS + k] -= coefficients[k]
        precisions[k] = math.exp(-2.0 * scales[groups[k]])
        if covariance[PARAMETERS + k, PARAMETERS + k] == 0.0:  # not active: as the prior has it
            covariance[PARAMETERS + k, PARAMETERS + k] = 1.0 / precisions[k]
    for k in range(q):
        cost += values[PARAMETERS + k] ** 2 * precisions[k]
    for i in range(size):
        left -= 2.0 * change[i] * normal.with_errors[i]
        for j in range(size):
            left += change[i] * normal.products[i, j] * change[j]
            used += covariance[i, j] * normal.products[j, i] / variance
    freedom = max(equations - used, 1.0)
    return _Solved(values, covariance, scales, decided, freedom, max(left, 0.0), cost, volume)


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
    """Columns that can move a point by more than a small part of the noise."""
    size = len(products)
    active, count = np.empty(size, dtype=np.int64), 0
    for i in range(size):
        moves = np.inf
        if i >= PARAMETERS:
            moves = math.exp(2.0 * scales[groups[i - PARAMETERS]]) * products[i, i]
        if moves > _NEGLIGIBLE * _NEGLIGIBLE * variance:
            active[count] = i
            count += 1
    return active[:count]


@inlined
def _inverse_of(
    products: Array, information: Array, scales: Array, groups: IntArray, active: IntArray,
    variance: float,
) -> Array:  # fmt: skip
    """Covariance of the active columns."""
    count = len(active)
    matrix = np.empty((count, count))
    for a in range(count):
        i = active[a]
        for b in range(count):
            matrix[a, b] = products[i, active[b]] / variance + information[i, active[b]]
        if i >= PARAMETERS:
            matrix[a, a] += math.exp(-2.0 * scales[groups[i - PARAMETERS]])
        matrix[a, a] *= _RIDGE
    return inverted(matrix)


@inlined
def _climb(
    scales: Array, uphill: Array, decided: Array, hyper_mean: Array, hyper_precision: Array
) -> None:
    """Newton's step of each log-scale (15,), held to be short."""
    before = scales.copy()
    for g in range(SCALES):
        climb = uphill[g] - hyper_precision[g] * (before[g] - hyper_mean[g])
        bend = 2.0 * decided[g] + hyper_precision[g]
        for other in (g - 1, g + 1):
            if g < SCALES - 1 and 0 <= other < SCALES - 1:
                climb -= _SMOOTH_SPECTRUM * (before[g] - before[other])
                bend += _SMOOTH_SPECTRUM
        step = min(max(climb / (bend + _TINY), -_LONGEST_SCALE_STEP), _LONGEST_SCALE_STEP)
        scales[g] = min(max(before[g] + step, _LEAST_LOG_SCALE), _MOST_LOG_SCALE)


@inlined
def _slope_of_scales(
    values: Array, inverse: Array, active: IntArray, groups: IntArray, scales: Array, decided: Array
) -> Array:
    """Slope (15,) of the log evidence by each log-scale: squares in deviations, less decided.

    Fills in how many coefficients of each scale the points decide (MacKay's gamma).
    """
    uphill = np.zeros(SCALES)
    for g in range(SCALES):
        precision, squares, known = math.exp(-2.0 * scales[g]), 0.0, 0.0
        for a in range(len(active)):
            if active[a] >= PARAMETERS and groups[active[a] - PARAMETERS] == g:
                squares += values[active[a]] * values[active[a]] * precision
                known += 1.0 - inverse[a, a] * precision
        decided[g] = max(known, 0.0)
        uphill[g] = squares - decided[g]
    return uphill


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
    data: Array, count: int, start: Array, gradient: Array, prior: PriorTerms, threshold: float,
    first_gate: float, first_noise: float, log_scales: Array, hyper_mean: Array,
    hyper_precision: Array, with_turns: bool, with_smooth: bool, most: int,
) -> FrameFit:  # fmt: skip
    """Fit motion, in-frame turn, smooth error, their scales, the noise and the inliers.

    Args:
        data: packed points, ``count`` of them.
        start: state (24,).
        gradient: (2,) row time by pixel.
        prior: of the motion without its in-frame turn.
        threshold: px, of inliers.
        first_gate, first_noise: px; the gate closes from there to what the noise decides.
        log_scales, hyper_mean, hyper_precision: (15,) where the logarithms of the scales start, and
            what is known of them.
        with_turns, with_smooth: whether there is an in-frame turn, a smooth error.
        most: steps.
    """
    q = (TURNS if with_turns else 0) + (2 * SMOOTH_TERMS if with_smooth else 0)
    size, first = PARAMETERS + q, TURNS if with_turns else 0
    state, coefficients = start.copy(), np.zeros(q)
    gate, noise, scales = first_gate, first_noise, log_scales.copy()
    solved = _Solved(
        np.zeros(size), np.zeros((size, size)), scales, np.zeros(SCALES), 0.0, 0.0, 0.0, 0.0
    )
    tau = _row_times(data, count)
    turns = np.zeros((FUNCTIONS if with_turns else 0, 3))
    inliers = squared_errors(data, count, state, gradient) < gate * gate
    prior_cost, finite, done = 0.0, True, False
    lines = linearized(data, count, state, gradient, shake_at(tau, turns))
    errors, squared = _beside(data, state, gradient, lines, inliers, coefficients[first:])
    for turn in range(most):
        kept = int(np.count_nonzero(inliers))
        if kept < _FEWEST:
            finite = False
            break
        normal = products_of(lines, inliers, errors, with_turns, with_smooth)
        information, slope, prior_cost = full_prior(prior, state, turns, size)
        solved = with_scales(
            normal, information, slope, coefficients, scales, hyper_mean, hyper_precision, noise,
            2 * kept, (_SCALE_ROUNDS if turn < 3 else _LATER_SCALE_ROUNDS) if q > 0 else 1,
        )  # fmt: skip
        values, scales = solved.values, solved.log_scales
        moved = _largest_move(values, coefficients, solved.covariance)
        if not np.isfinite(moved):
            finite = False
            break
        state = apply_step(state, values[:PARAMETERS])
        coefficients = values[PARAMETERS:].copy()
        for k in range(len(turns)):
            for axis in range(3):
                turns[k, axis] = coefficients[3 * k + axis]
        lines = linearized(data, count, state, gradient, shake_at(tau, turns))
        errors, squared = _beside(data, state, gradient, lines, inliers, coefficients[first:])
        noise = noise_deviation(squared, gate, max(2.0 * kept - solved.freedom, 0.0))
        closed = gate <= WIDEST_GATE * threshold
        gate = max(_CLOSING * gate, min(max(threshold, GATE * noise), WIDEST_GATE * threshold))
        inliers = squared < gate * gate
        if done or (closed and moved < _SHORT):
            if done:
                break
            done = True
    variance, chosen = noise * noise, PARAMETERS + first
    cost = solved.left / variance + prior_cost + solved.prior_cost
    kept = int(np.count_nonzero(inliers))
    evidence = 0.5 * (solved.log_determinant - cost) - kept * math.log(variance)
    smooth = math.exp(scales[SCALES - 1]) if with_smooth else 0.0
    agreement = neighbours_agree(errors, tau, lines.image, inliers)
    finite = finite and bool(np.all(np.isfinite(solved.covariance)))
    return FrameFit(
        state, turns, solved.covariance[:chosen, :chosen].copy(), noise, solved.freedom, inliers,
        squared, scales, solved.decided, smooth, agreement, evidence,
        solved.left / variance, prior_cost + solved.prior_cost, solved.log_determinant, finite,
    )  # fmt: skip


@kernel
def _beside(
    data: Array, state: Array, gradient: Array, lines: Lines, inliers: BoolArray, smooth: Array
) -> tuple[Array, Array]:
    """Errors (n,2) beside the smooth one, and their squares (n,); infinite behind the camera."""
    errors = lines.errors.copy()
    if len(smooth) > 0:
        errors += smooth_at(lines, inliers, smooth)
    squared = squared_errors(data, len(errors), state, gradient)
    for i in range(len(errors)):
        if np.isfinite(squared[i]):
            squared[i] = errors[i, 0] ** 2 + errors[i, 1] ** 2
    return errors, squared


@inlined
def _largest_move(values: Array, coefficients: Array, covariance: Array) -> float:
    """Square of the longest part of a step, in deviations; NaN where one is not finite."""
    longest = 0.0
    for i in range(len(values)):
        change = values[i] - (coefficients[i - PARAMETERS] if i >= PARAMETERS else 0.0)
        part = change * change / max(covariance[i, i], _TINY)
        if not part <= longest:
            longest = part
    return longest


def warm_up() -> None:
    """Compile what frames with smooth errors come to."""
    smooth_terms(np.zeros(2), np.zeros(2), np.ones(2), np.zeros(SMOOTH_TERMS))
