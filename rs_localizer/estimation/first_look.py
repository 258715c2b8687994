# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The first look at a frame: its best motion alone, what would explain what that leaves, and what
vibration that hides does to it.

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
from rs_localizer.core.scales import SCALES, Scales
from rs_localizer.core.shake import (
    COMBINATIONS,
    CYCLES,
    FUNCTIONS,
    IN_COMBINATIONS,
    RESOLVED,
    TYPICAL_SIZES,
    shake_basis,
)
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.state import LINEAR, MOTION_PARAMETERS, PARAMETERS, VELOCITIES
from rs_localizer.estimation.frame_fit import (
    SMOOTH_TERMS,
    extent,
    neighbours_agree,
    smooth_terms,
)
from rs_localizer.estimation.mirror import leaning_less, plane_of
from rs_localizer.estimation.observations import NEAREST, median_depth
from rs_localizer.estimation.posterior import LEAST_EIGENVALUE, Best, best_motion
from rs_localizer.estimation.prior import PriorTerms, add_prior
from rs_localizer.estimation.refine import inverted
from rs_localizer.estimation.residuals import linearized, squared_errors

# Where a hyperprior is sampled, in its deviations: three in a decade of scales.
_NODES = np.linspace(-2.25, 2.25, 7)
_WEIGHTS = np.exp(-0.5 * _NODES**2) / np.exp(-0.5 * _NODES**2).sum()
# Columns explain this part of the errors at most: the linear model holds no farther.
_MOST_EXPLAINED = 0.95
# No frame says more than this to the next ones (standard normal).
_CLIPPED = 6.0
# Products of a turn of three axes with the motion and the errors.
_OUTER = 3 * PARAMETERS + 3
# Points just outside of the gate that are no chance: shaking may have moved them there. The corners
# of one marker may, beside four and more others, be misplaced in the map. Beside fewer points, 12
# or 13 are a plain motion's of 20 that shake by a degree, and 3 or 4 lie just outside: of 25 such
# frames one was inside its region (benchmarks.frames bands).
_MARKER = 4
_NEAR_PART, _NEAR_GATE = 0.2, 8.0
# Hyperprior of the scales where no frame says more: an ordinary vibration, a decade up or down
# within one deviation; a map and a lens of 0.03 px, to a factor of e: surveyed tags before a
# calibrated lens have 0.2 (two deviations).
_TURN_SCALES = np.log(TYPICAL_SIZES)
# What is declared of a map is known to a factor of e, too: thirteen printed boards
# (benchmarks.real) are bent 0.3 to 9 times as much as 0.2 mm per 10 cm, 1.0 of the logarithm. A
# motion that makes a bent board look flat is less probable than one before a bent board.
_SMOOTH_SCALE, _PRECISION, _SMOOTH_PRECISION = math.log(0.03), 1.0 / 2.3**2, 1.0
# Scales from which a fit starts: those that it does not need shrink fast, those that it needs grow
# slowly.
_FIRST_TURN, _FIRST_SMOOTH = math.log(5e-3), math.log(0.3)
# Velocities beyond doubt, in squared standard deviations (four times the 99 % quantile of six), of
# which the prior knows less than this part: typical speeds are not weighed.
_CLEARLY_MOVING, _LITTLE_OF_THE_PRIOR = 67.0, 0.05


class Hyperprior(NamedTuple):
    """Of the logarithms (15,) of the scales."""

    first: Array  # where a fit starts
    mean: Array
    precision: Array


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


class ScoreProducts(NamedTuple):
    """Products of columns at a motion without in-frame turn and smooth error, over the inliers."""

    own: Array  # (14,6,6) of each frequency's columns with themselves
    by_motion: Array  # (14,6,18) and with the motion's
    along: Array  # (14,6) and with the negative errors
    smooth: Array  # (20,20) of the smooth error's
    smooth_by_motion: Array  # (20,18)
    smooth_along: Array  # (20,)
    # (48,48), (48,18), (48,): the same of what the rows resolve of all frequencies (core/shake.py)
    together: Array
    together_by_motion: Array
    together_along: Array
    inverse: Array  # (18,18) of the motion's, with the prior's information


@kernel
def score_products(
    data: Array, count: int, state: Array, inliers: BoolArray, prior: PriorTerms,
    variance: float, turns: bool,
) -> tuple[ScoreProducts, float]:  # fmt: skip
    """What tells how much an in-frame turn and a smooth error would explain (Rao 1948).

    A column of the turn is a function of the row time times a derivative: their products are sums
    of products of the one times products of the other.

    Args:
        variance: of the noise, px^2.
        turns: whether products of in-frame turns are wanted; without, they are zero.

    Returns:
        the products, and how much the errors of neighbouring rows agree.
    """
    lines = linearized(data, count, state, np.zeros((count, 6)))
    front = squared_errors(data, count, state)
    frequencies = SCALES - 1
    information, slope = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    add_prior(prior, state, variance, information, slope)
    # By the functions of the row time: the derivatives' products with motion and errors, and with
    # themselves (the functions squared and multiplied).
    crossed, own = np.zeros((RESOLVED, _OUTER)), np.zeros((6, RESOLVED * (RESOLVED + 1) // 2))
    # By the terms of the smooth error: the motion's derivatives and the errors; themselves.
    beside, within = (
        np.zeros((SMOOTH_TERMS, 2 * PARAMETERS + 2)),
        np.zeros((SMOOTH_TERMS, SMOOTH_TERMS)),
    )
    values, rates, terms = np.empty(FUNCTIONS), np.empty(FUNCTIONS), np.empty(SMOOTH_TERMS)
    outer, both = np.empty(_OUTER), np.empty(2 * PARAMETERS + 2)
    resolved, squares = np.empty(RESOLVED), np.empty(own.shape[1])
    low, high = extent(lines, inliers)
    for i in range(count):
        if not inliers[i] or not np.isfinite(front[i]):
            continue
        rows, by_turn, errors = lines.by_motion[i], lines.by_turn[i], lines.errors[i]
        for a in range(PARAMETERS):
            for b in range(PARAMETERS):
                information[a, b] += rows[0, a] * rows[0, b] + rows[1, a] * rows[1, b]
            both[a], both[PARAMETERS + a] = rows[0, a], rows[1, a]
        both[2 * PARAMETERS], both[2 * PARAMETERS + 1] = errors[0], errors[1]
        smooth_terms(lines.image[i], low, high, terms)
        _add_outer(beside, terms, both)
        _add_outer(within, terms, terms)
        if turns:
            shake_basis(lines.tau[i], values, rates)
            resolved[:] = 0.0
            for k in range(FUNCTIONS):
                for j in range(RESOLVED):
                    resolved[j] += values[k] * COMBINATIONS[k, j]
            _turn_products(rows, by_turn, errors, resolved, outer, squares, own)
            _add_outer(crossed, resolved, outer)
    products = ScoreProducts(
        np.empty((frequencies, 6, 6)), np.empty((frequencies, 6, PARAMETERS)),
        np.empty((frequencies, 6)), np.zeros((2 * SMOOTH_TERMS, 2 * SMOOTH_TERMS)),
        np.empty((2 * SMOOTH_TERMS, PARAMETERS)), np.empty(2 * SMOOTH_TERMS),
        np.empty((3 * RESOLVED, 3 * RESOLVED)), np.empty((3 * RESOLVED, PARAMETERS)),
        np.empty(3 * RESOLVED), inverted(information),
    )  # fmt: skip
    if turns:
        _spread_turns(products, own, crossed)
    for i in range(2 * SMOOTH_TERMS):
        side, k = i // SMOOTH_TERMS, i % SMOOTH_TERMS
        for j in range(SMOOTH_TERMS):
            products.smooth[i, SMOOTH_TERMS * side + j] = within[k, j]
        for a in range(PARAMETERS):
            products.smooth_by_motion[i, a] = beside[k, PARAMETERS * side + a]
        products.smooth_along[i] = -beside[k, 2 * PARAMETERS + side]
    return products, neighbours_agree(lines.errors, lines.tau, lines.image, inliers)


@kernel
def _add_outer(total: Array, left: Array, right: Array) -> None:
    """Add the products of each number of one vector with each of another."""
    for i in range(len(left)):
        row, factor = total[i], left[i]
        for j in range(len(right)):
            row[j] += factor * right[j]


@inlined
def _turn_products(
    rows: Array, by_turn: Array, errors: Array, values: Array, outer: Array, squares: Array,
    own: Array,
) -> None:  # fmt: skip
    """Fill in a point's products of turn and motion, turn and errors; add those of the turn."""
    for axis in range(3):
        one, other = by_turn[0, axis], by_turn[1, axis]
        for a in range(PARAMETERS):
            outer[PARAMETERS * axis + a] = one * rows[0, a] + other * rows[1, a]
        outer[3 * PARAMETERS + axis] = one * errors[0] + other * errors[1]
    place = 0
    for k in range(len(values)):
        for j in range(k + 1):
            squares[place] = values[k] * values[j]
            place += 1
    for axis in range(3):
        for other_axis in range(axis + 1):
            product = by_turn[0, axis] * by_turn[0, other_axis]
            product += by_turn[1, axis] * by_turn[1, other_axis]
            place = axis * (axis + 1) // 2 + other_axis
            for j in range(len(squares)):
                own[place, j] += product * squares[j]


@kernel
def _spread_turns(products: ScoreProducts, own: Array, crossed: Array) -> None:
    """Write the products of the resolved combinations (axes within them), and of each frequency's
    columns (axes of the cosine, then of the sine), which are sums of these.
    """
    of_functions = IN_COMBINATIONS.T @ crossed
    for axis in range(3):
        first, last = PARAMETERS * axis, PARAMETERS * (axis + 1)
        products.together_by_motion[axis::3] = crossed[:, first:last]
        products.together_along[axis::3] = -crossed[:, 3 * PARAMETERS + axis]
        for side in range(2):
            column = 3 * side + axis
            products.by_motion[:, column] = of_functions[side::2, first:last]
            products.along[:, column] = -of_functions[side::2, 3 * PARAMETERS + axis]
        for other in range(axis + 1):
            place, both = 0, np.empty((RESOLVED, RESOLVED))
            for k in range(RESOLVED):
                for j in range(k + 1):
                    both[k, j] = both[j, k] = own[axis * (axis + 1) // 2 + other, place]
                    place += 1
            products.together[axis::3, other::3] = both
            products.together[other::3, axis::3] = both
            half = both @ IN_COMBINATIONS
            for f in range(len(products.own)):
                for k in range(4):
                    total, one, two = 0.0, 2 * f + k // 2, 2 * f + k % 2
                    for i in range(RESOLVED):
                        total += IN_COMBINATIONS[i, one] * half[i, two]
                    row, column = 3 * (k // 2) + axis, 3 * (k % 2) + other
                    products.own[f, row, column] = products.own[f, column, row] = total


@kernel
def standard_scores(explained: Array, own: Array, freedom: float) -> Array:
    """How much more than chance columns explain (15,), standard normal where there is nothing.

    An F test, because the noise is of the same errors (Rao 1948), by Paulson's approximation
    (1942).

    Args:
        explained: (15,) squares in noise variances.
        own: (15,) how many columns explain them that the motion does not mimic.
        freedom: of the errors.
    """
    scores = np.empty(len(own))
    for k in range(len(own)):
        rest = max(freedom - own[k], 1.0)
        left = max(freedom - explained[k], 1e-3 * max(freedom, 1.0))
        cube = np.cbrt(explained[k] / own[k] * rest / left)
        a, b = 2.0 / (9.0 * own[k]), 2.0 / (9.0 * rest)
        standard = ((1.0 - b) * cube - (1.0 - a)) / math.sqrt(b * cube**2 + a)
        enough = freedom - own[k] >= 1.0
        scores[k] = min(max(standard, -_CLIPPED), _CLIPPED) if enough else -_CLIPPED
    return scores


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


class Look(NamedTuple):
    """The best motion alone, and what it leaves."""

    best: Best
    is_mirrored: bool
    mirrored: Array  # (24,) the other lean of a plane
    planar: bool
    depth: float  # m
    declared: float  # px, of the map
    hyper: Hyperprior
    near_outliers: int
    moving: bool  # neither rest nor another typical speed would change anything
    excess: Array  # (15,) by how much more than chance each scale would explain, standard normal
    agreement: float
    vibration: Undetected


@kernel
def first_look(
    data: Array, points: Array, start: Array, terms: PriorTerms, threshold: float,
    map_deviation: float, focal_length: float, rolling: bool, turn_known: bool, known: Scales,
) -> Look:  # fmt: skip
    """The best motion near a state (24,), and what tells whether it is all."""
    best = best_motion(data, len(points), start, terms, threshold)
    hyper, nothing = _hyperprior(known, 0.0), np.zeros((0, 0))
    if not best.smallest_eigenvalue > LEAST_EIGENVALUE:
        return Look(
            best, False, start, False, 0.0, 0.0, hyper, 0, False, start, 0.0,
            Undetected(0.0, nothing),
        )  # fmt: skip
    is_mirrored, mirrored = leaning_less(points, best.inliers, best.state, 2.0)
    if is_mirrored:
        again = best_motion(data, len(points), mirrored, terms, threshold)
        if (
            again.smallest_eigenvalue > LEAST_EIGENVALUE
            and again.cost < best.cost - best.noise**2
            and np.count_nonzero(again.inliers) >= np.count_nonzero(best.inliers)
        ):
            best = again
            is_mirrored, mirrored = leaning_less(points, best.inliers, best.state, 2.0)
    depth = median_depth(data, best.state, best.inliers)
    if depth < NEAREST:  # NaN: there are no inliers
        depth = NEAREST
    declared = map_deviation * focal_length / depth
    hyper = _hyperprior(known, declared)
    size, precision = _size_of_vibration(hyper)
    explained, coefficients, agreement, vibration = score_statistics(
        data, len(points), best.state, best.inliers, terms, best.noise, best.freedom, size,
        precision, rolling,
    )  # fmt: skip
    near = near_outliers(best.squared_errors, best.inliers, threshold) if rolling else 0
    return Look(
        best, is_mirrored, mirrored, plane_of(points, best.inliers)[0], depth, declared, hyper,
        near, _clearly_moving(best, terms, turn_known),
        standard_scores(explained, coefficients, best.freedom), agreement, vibration,
    )  # fmt: skip


@kernel
def near_outliers(squared_errors: Array, inliers: BoolArray, threshold: float) -> int:
    """Points just beyond the gate, where they are too many to be chance; else 0."""
    within = squared_errors < (_NEAR_GATE * threshold) ** 2
    count = int(np.count_nonzero(within & ~inliers))
    most = np.count_nonzero(inliers)
    shaken = count > _MARKER or most < 4 * _MARKER
    return count if shaken and count >= _NEAR_PART * most else 0


@kernel
def _hyperprior(known: Scales, declared: float) -> Hyperprior:
    """What is known of the scales of a frame; ``declared``: px, of the map."""
    first, mean, both = np.empty(SCALES), np.empty(SCALES), np.empty(SCALES)
    for g in range(SCALES):
        first[g], own, precision = _FIRST_TURN, _SMOOTH_SCALE, _PRECISION
        if g < SCALES - 1:
            own = _TURN_SCALES[g]
        else:
            own, precision = math.log(declared) if declared > 0.0 else own, _SMOOTH_PRECISION
            first[g] = max(_FIRST_SMOOTH, own)
        both[g] = precision + known.precisions[g]
        mean[g] = (precision * own + known.precisions[g] * known.means[g]) / both[g]
        if known.precisions[g] > 1.0:
            first[g] = mean[g]
    return Hyperprior(first, mean, both)


@inlined
def _size_of_vibration(hyper: Hyperprior) -> tuple[float, float]:
    """Logarithm of a factor of all scales of the in-frame turn, and its precision: one decade, and
    what the frames before say of each scale.
    """
    away, precision = 0.0, _PRECISION
    for g in range(SCALES - 1):
        away += hyper.precision[g] * (hyper.mean[g] - _TURN_SCALES[g])
        precision += hyper.precision[g] - _PRECISION
    return away / precision, precision


@inlined
def _clearly_moving(best: Best, terms: PriorTerms, turn_known: bool) -> bool:
    """Whether neither rest nor another typical speed would change anything."""
    first = LINEAR.start if turn_known else VELOCITIES.start  # of the others a gyroscope knows
    spread = best.covariance[first : VELOCITIES.stop, first : VELOCITIES.stop].copy()
    information, part, squared = inverted(spread), 0.0, 0.0
    velocities = best.state[6 + first : 6 + VELOCITIES.stop]  # a state's pose is longer by six
    for i in range(len(spread)):
        part += terms.informations[0, first + i, first + i] * spread[i, i]
        for j in range(len(spread)):
            squared += velocities[i] * information[i, j] * velocities[j]
    return part < _LITTLE_OF_THE_PRIOR and squared > _CLEARLY_MOVING
