# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors that points share, as correlated noise: marginalized in closed form.

What a map, a board or a lens is off by is smooth. Of a frame linearized at a state,

    e = M x + S f + noise,      f ~ N(0, s^2),  noise ~ N(0, n^2)

with the columns ``S`` of smooth errors (cubics of image and depth; of a map that is declared to be
off, polynomials of its places, projected), the errors' covariance is ``n^2 + s^2 S S^T``. With
``S = U diag(d)^(1/2) V^T`` all that a fit needs follows, for every size ``s`` and noise ``n``, from
the products ``M^T M``, ``U^T M`` and ``U^T e`` alone:

    M^T W M = (M^T M - (U^T M)^T diag(a) U^T M) / n^2,      a = s^2 d / (n^2 + s^2 d)

The size is integrated over a grid about what is known of it; the noise is at each size the one that
the errors leave (restricted likelihood: Patterson, Thompson 1971).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import legvander

from rs_localizer.core.arrays import Array, Array1, Array2, Array3, BoolArray, BoolArray1
from rs_localizer.core.state import MOVE, PARAMETERS, TURN
from rs_localizer.estimation.prior import PriorTerms
from rs_localizer.estimation.refine import LEAST_NOISE, half_inverse, squared
from rs_localizer.estimation.residuals import Lines, linearized
from rs_localizer.native import entry, kernel

DEGREE = 3
# Expected size of each degree: printers stretch paper, lenses bend at the rim; the mean square
# over the image of a field of size 1 that has no depth is 1.
_DEGREE_SIZES = (1.0, 1.0, 0.5, 0.25)
# So much smaller for each power of the depth: a map is off by more where it is near, a lens not.
# With 1 a phone's lens is taken for its map, with 0.5 fewer regions hold in a room that is bent.
_DEPTH = 0.7
_POWERS = np.array([
    (i, j, degree - i - j)
    for degree in range(DEGREE + 1)
    for i in range(degree + 1)
    for j in range(degree + 1 - i)
])  # fmt: skip
TERMS = len(_POWERS)
_TERM_SIZES = np.array([
    _DEGREE_SIZES[i + j + k] * _DEPTH**k * math.sqrt((2 * i + 1) * (2 * j + 1) * (2 * k + 1))
    for i, j, k in _POWERS.tolist()
]) / math.sqrt(sum((d + 1) * size**2 for d, size in enumerate(_DEGREE_SIZES)))  # fmt: skip
# Paper bends in finer waves than lenses: to a cubic a curled edge looks like fast motion.
_BENT_SIZES = (*_DEGREE_SIZES, 0.125)
# Combinations of functions that move no point by this part of the size are left out.
_LEAST_BEND = 0.003
_LEAST_EXTENT = 1e-6  # m; points nearer together than this are one place, and nothing bends
# Combinations of columns with less than this part of the largest square are left out.
_LEAST_SQUARE = 1e-4
ORDINARY = 0.03
"""Size (px) of the smooth error of an ordinary map and lens: no calibration is better."""
# Sizes about the known one, in deviations of its logarithm: surveyed tags before a calibrated lens
# have 0.2 px (two of them), and thirteen printed boards bend 0.3 to 9 times as much as declared.
# A lens that misses a third of its distortion is off by six deviations.
_SIZES = np.linspace(-2.5, 5.5, 11)
_MASS = float(np.log(np.exp(-0.5 * _SIZES**2).sum()))
# Noise beside a smooth error is so many times that of the fit without one.
_LEAST_PART, _MOST_PART = 0.16, 1.3
# Of the equations, what columns leave to measure the noise with.
_LEAST_FREEDOM = 0.1
# Logarithm of the odds below which larger sizes are not looked at, and a size has no part.
_HOPELESS, _NO_PART = 12.0, 1e-3


class SmoothError(NamedTuple):
    """The columns of smooth errors at the inliers, and what is known of their size."""

    rows: Array2  # (2m,q) orthonormal combinations of the columns
    squares: Array1  # (q,) of the columns' lengths, for a size of 1 px
    log_size: float  # px, mean of the logarithm, whose deviation is 1


class Noise(NamedTuple):
    """Noise by the fit without a smooth error."""

    deviation: float  # px
    correction: float  # of the mean square, because the gate cuts errors off
    decided: float  # parameters that the points decide


class Products(NamedTuple):
    """Products of the columns of a frame, linearized at a state."""

    own: Array  # (18,18) of the motion
    along: Array  # (18,) with the errors
    square: float  # px^2, of the errors
    by_motion: Array  # (q,18) of the smooth error and the motion
    on_errors: Array  # (q,) and the errors


class Sized(NamedTuple):
    """A Gaussian about the optimum, integrated over the size of the smooth error."""

    step: Array  # (18,) from where the products are
    covariance: Array  # (18,18)
    evidence: float  # logarithm
    noise: float  # px
    size: float  # px, root mean square
    freedom: float


@entry
def smooth_columns(by_motion: Array3, rays: Array2, bend: Array2) -> Array:
    """Shifts (n,2,q) in px of points by each coefficient of a smooth error of 1 px.

    Args:
        by_motion: (n,2,18) derivatives; a point that moves is a camera that moves back.
        rays: (n,2).
        bend: (n,b) functions of the places in the map (:func:`bend_of`); (n,0): of image and depth.
    """
    count = len(rays)
    if bend.shape[1] > 0:
        bent = np.empty((count, 2, 3 * bend.shape[1]))
        for i in range(count):
            for side in range(2):
                for k in range(bend.shape[1]):
                    for axis in range(3):
                        bent[i, side, 3 * k + axis] = (
                            -by_motion[i, side, MOVE.start + axis] * bend[i, k]
                        )
        return bent
    columns = np.zeros((count, 2, 2 * TERMS))
    places, powers = _places_of(by_motion, rays), np.ones((3, DEGREE + 1))
    for i in range(count):
        for axis in range(3):
            power, x = powers[axis], places[i, axis]
            power[1] = x
            for k in range(2, DEGREE + 1):  # Legendre
                power[k] = ((2 * k - 1) * x * power[k - 1] - (k - 1) * power[k - 2]) / k
        for place in range(TERMS):
            value = _TERM_SIZES[place]
            for axis in range(3):
                value *= powers[axis, _POWERS[place, axis]]
            columns[i, 0, place] = columns[i, 1, TERMS + place] = value
    return columns


@kernel
def _places_of(by_motion: Array, rays: Array) -> Array:
    """Places (n,3) in image and depth, at most 1: depths are in parts of the scene's extent."""
    places, low, high = np.empty((len(rays), 3)), np.full(5, np.inf), np.full(5, -np.inf)
    each = np.empty(5)
    for i in range(len(rays)):
        x, y = rays[i]
        turn = move = 0.0
        for side in range(2):
            for axis in range(3):
                turn += by_motion[i, side, TURN.start + axis] ** 2
                move += by_motion[i, side, MOVE.start + axis] ** 2
        # What a turn moves has no depth.
        flat = 2.0 * (x * y) ** 2 + (1.0 + x * x) ** 2 + (1.0 + y * y) ** 2 + x * x + y * y
        depth = math.sqrt(turn / flat * (2.0 + x * x + y * y) / max(move, 1e-300))
        places[i, 0], places[i, 1], places[i, 2] = x, y, depth
        each[0], each[1], each[2], each[3], each[4] = x, y, depth, x * depth, y * depth
        low, high = np.minimum(low, each), np.maximum(high, each)
    extents = 0.5 * (high - low)
    extents[2] = max(extents[2], extents[3], extents[4])
    for i in range(len(rays)):
        for axis in range(3):
            middle = 0.5 * (low[axis] + high[axis])
            places[i, axis] = (places[i, axis] - middle) / max(extents[axis], 1e-12)
    return places


def bend_of(points: Array, inliers: BoolArray, size: float) -> Array:
    """Functions (n,b) of the points' places; ``size``: m, their root mean square, all together."""
    sizes = _BENT_SIZES
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


@entry
def smooth_error(lines: Lines, chosen: BoolArray1, bend: Array2, log_size: float) -> SmoothError:
    """The smooth error at the chosen ones of points (n,), orthogonal columns.

    Args:
        bend: (n,b), or (n,0): see :func:`smooth_columns`.
        log_size: what is known of the size (px).
    """
    columns = smooth_columns(lines.by_motion[chosen], lines.image[chosen], bend[chosen])
    count, q = len(columns), columns.shape[2]
    if bend.shape[1] == 0:  # u and v have the same functions
        half = np.ascontiguousarray(columns[:, 0, :TERMS])
        values, axes = np.linalg.eigh(half.T @ half)
        kept = np.flatnonzero(values > _LEAST_SQUARE * max(values[-1], 1e-300))
        each, few = half @ np.ascontiguousarray(axes[:, kept]), len(kept)
        rows, squares = np.zeros((2 * count, 2 * few)), np.empty(2 * few)
        for k in range(few):
            squares[k] = squares[few + k] = values[kept[k]]
            length = math.sqrt(values[kept[k]])
            for i in range(count):
                rows[2 * i, k] = rows[2 * i + 1, few + k] = each[i, k] / length
        return SmoothError(rows, squares, log_size)
    flat = columns.reshape(2 * count, q)
    values, axes = np.linalg.eigh(flat.T @ flat)
    kept = np.flatnonzero(values > _LEAST_SQUARE * max(values[-1], 1e-300))
    squares = values[kept]
    rows = flat @ np.ascontiguousarray(axes[:, kept])
    for k in range(len(kept)):
        rows[:, k] /= math.sqrt(squares[k])
    return SmoothError(rows, squares, log_size)


@entry
def nothing_shared(count: int) -> SmoothError:
    """The smooth error of so many inliers where there is none."""
    return SmoothError(np.zeros((2 * count, 1)), np.zeros(1), 0.0)


@kernel
def products_at(data: Array, count: int, state: Array, chosen: BoolArray, rows: Array) -> Products:
    """The products of packed points at a state (24,); ``rows`` (2m,q) of the smooth error."""
    lines = linearized(data, count, state, np.zeros((count, 6)))
    each, place = np.empty((len(rows), PARAMETERS + 1)), 0
    for i in range(count):
        if chosen[i]:
            for side in range(2):
                row = each[place]
                for k in range(PARAMETERS):
                    row[k] = lines.by_motion[i, side, k]
                row[PARAMETERS] = lines.errors[i, side]
                place += 1
    every, beside = each.T @ each, rows.T @ each
    return Products(
        every[:PARAMETERS, :PARAMETERS].copy(), every[:PARAMETERS, PARAMETERS].copy(),
        every[PARAMETERS, PARAMETERS], beside[:, :PARAMETERS].copy(), beside[:, PARAMETERS].copy(),
    )  # fmt: skip


@kernel
def taken_by(squares: Array, size: float, noise: float) -> Array:
    """Share (q,) of what the errors show of each column that the smooth error takes."""
    taken = np.empty(len(squares))
    for k in range(len(squares)):
        own = size * size * squares[k]
        taken[k] = own / (noise * noise + own)
    return taken


@kernel
def weighed(products: Products, taken: Array, information: Array, slope: Array) -> float:
    """Fill in ``M^T W M`` (18,18) and ``M^T W e`` (18,), times the noise variance; ``e^T W e``."""
    for i in range(PARAMETERS):
        slope[i] = products.along[i]
        for j in range(PARAMETERS):
            information[i, j] = products.own[i, j]
    left = products.square
    for k in range(len(taken)):
        share, row = taken[k], products.by_motion[k]
        error = share * products.on_errors[k]
        left -= error * products.on_errors[k]
        for i in range(PARAMETERS):
            slope[i] -= error * row[i]
            part = share * row[i]
            into = information[i]
            for j in range(PARAMETERS):
                into[j] -= part * row[j]
    return left


@kernel
def _rest_of(products: Products, taken: Array, step: Array) -> float:
    """Sum of the squares (px^2) that are noise, after a step."""
    total = products.square + 2.0 * np.sum(products.along * step)
    for i in range(PARAMETERS):
        row, along = products.own[i], 0.0
        for j in range(PARAMETERS):
            along += row[j] * step[j]
        total += step[i] * along
    for k in range(len(taken)):
        seen, row = products.on_errors[k], products.by_motion[k]
        for i in range(PARAMETERS):
            seen += row[i] * step[i]
        total -= (1.0 - (1.0 - taken[k]) ** 2) * seen * seen
    return max(total, 0.0)


@kernel
def volume_of(terms: PriorTerms) -> float:
    """Half the logarithm of the determinant of what the prior of a motion knows."""
    volume = 0.0
    for k in range(PARAMETERS):
        if terms.informations[0, k, k] > 0.0:
            volume += 0.5 * math.log(terms.informations[0, k, k])
    return volume


@kernel
def noise_beside(
    products: Products, smooth: SmoothError, taken: Array, step: Array, noise: Noise
) -> tuple[float, float]:
    """Noise (px) beside a smooth error that takes these shares, after a step; its freedom."""
    equations = len(smooth.rows)
    freedom = max(equations - noise.decided - np.sum(taken), _LEAST_FREEDOM * max(equations, 1))
    variance = noise.correction * _rest_of(products, taken, step) / freedom
    usual = max(noise.deviation, ORDINARY)
    return max(
        min(max(math.sqrt(variance), _LEAST_PART * usual), _MOST_PART * usual), LEAST_NOISE
    ), freedom


@kernel
def over_sizes(
    products: Products, smooth: SmoothError, information: Array, slope: Array, prior_cost: float,
    volume: float, noise: Noise,
) -> Sized:  # fmt: skip
    """Integrate over the size of the smooth error.

    Args:
        information, slope, prior_cost: (18,18), (18,), of the prior of the motion.
        volume: of it, see :func:`volume_of`.
    """
    grid = len(_SIZES) if smooth.squares[-1] > 0.0 else 1
    equations, deviation = len(smooth.rows), max(noise.deviation, LEAST_NOISE)
    steps, evidences = np.zeros((grid, PARAMETERS)), np.full(grid, -np.inf)
    covariances = np.empty((grid, PARAMETERS, PARAMETERS))
    sizes, noises, left_over = np.zeros(grid), np.zeros(grid), np.ones(grid)
    matrix, right = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    best = -np.inf
    for g in range(grid):
        away = _SIZES[g] if grid > 1 else 0.0
        sizes[g] = math.exp(smooth.log_size + away) if grid > 1 else 0.0
        for _ in range(2 if g == 0 and grid > 1 else 1):
            variance = deviation * deviation
            taken = taken_by(smooth.squares, sizes[g], deviation)
            left = weighed(products, taken, matrix, right)
            for i in range(PARAMETERS):
                right[i] = right[i] / variance + slope[i]
                for j in range(PARAMETERS):
                    matrix[i, j] = matrix[i, j] / variance + information[i, j]
            half, scale, positive = half_inverse(matrix)
            if not positive:
                break
            step, log_determinant = _solved(half, scale, right)
            steps[g], noises[g] = step, deviation
            if grid > 1:
                deviation, left_over[g] = noise_beside(products, smooth, taken, step, noise)
            else:
                left_over[g] = max(equations - noise.decided, 1.0)
        if not positive:
            break
        gained = -np.sum(right * steps[g])
        cost = left / variance + prior_cost - gained
        spread = 0.0
        for k in range(len(taken)):
            spread -= math.log1p(-taken[k])
        density = equations * math.log(2.0 * math.pi * variance)
        evidences[g] = volume - 0.5 * (cost + density + spread + log_determinant + away * away)
        covariances[g] = squared(half, scale)
        best = max(best, evidences[g])
        if evidences[g] < best - _HOPELESS and away > 0.0:
            break
    return _integrated(steps, covariances, evidences, sizes, noises, left_over)


@kernel
def _solved(half: Array, scale: Array, right: Array) -> tuple[Array, float]:
    """Solution of ``A x = -right`` by the half inverse of ``A``; log-determinant of ``A``."""
    size, total = len(right), 0.0
    solution, inner = np.zeros(size), np.zeros(size)
    for k in range(size):
        row, part = half[k], 0.0
        for i in range(k + 1):
            part += row[i] * scale[i] * right[i]
        inner[k] = part
        total -= 2.0 * math.log(row[k] * scale[k])
    for k in range(size):
        row, part = half[k], inner[k]
        for i in range(k + 1):
            solution[i] -= row[i] * part
    return solution * scale, total


@kernel
def _integrated(
    steps: Array, covariances: Array, evidences: Array, sizes: Array, noises: Array,
    left_over: Array,
) -> Sized:  # fmt: skip
    best, grid = int(np.argmax(evidences)), len(sizes)
    if not evidences[best] > -np.inf:
        nothing = np.full(PARAMETERS, np.nan)
        return Sized(
            nothing, np.full((PARAMETERS, PARAMETERS), np.nan), -np.inf, noises[0], 0.0,
            1.0,
        )  # fmt: skip
    weights = np.exp(evidences - evidences[best])
    total = np.sum(weights)
    weights /= total
    step, noise, size, freedom = np.zeros(PARAMETERS), 0.0, 0.0, 0.0
    for g in range(grid):
        step += weights[g] * steps[g]
        noise += weights[g] * noises[g]
        size += weights[g] * sizes[g] ** 2
        freedom += weights[g] * left_over[g]
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    for g in range(grid):
        if weights[g] < _NO_PART:
            continue
        own, away = covariances[g], steps[g] - step
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                covariance[i, j] += weights[g] * (own[i, j] + away[i] * away[j])
    return Sized(
        step, covariance, evidences[best] + math.log(total) - (_MASS if grid > 1 else 0.0),
        noise, math.sqrt(size), max(freedom, 6.0),
    )  # fmt: skip
