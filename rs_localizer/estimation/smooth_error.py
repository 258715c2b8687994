# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors that points share: what a map, a board or a lens is off by is smooth.

Columns of cubics of image and depth; of a map that is declared to be off, of polynomials of its
places, projected. Beside what a frame is fitted by they are correlated noise (:mod:`.linear_fit`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import legvander

from rs_localizer.core.arrays import Array, Array1, Array2, Array3, BoolArray, BoolArray1
from rs_localizer.core.state import MOVE, TURN
from rs_localizer.estimation.projection import Lines
from rs_localizer.native import entry, kernel

DEGREE = 3
# Expected size of each degree: printers stretch paper, lenses bend at the rim; the mean square
# over the image of a field of size 1 that has no depth is 1.
_DEGREE_SIZES = (1.0, 1.0, 0.5, 0.25)
# Factor for each power of the depth: a map has larger errors nearby, a lens does not. With 1 a
# phone's lens is taken for its map; with 0.5 fewer regions hold in a room that is bent.
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
_ODDS = -0.5 * _SIZES**2 - math.log(np.exp(-0.5 * _SIZES**2).sum())


class Shared(NamedTuple):
    """Columns of errors that the chosen points share, and what is known of their size."""

    rows: Array2  # (2m,q) orthonormal combinations of the columns
    squares: Array1  # (q,) of the columns' lengths, for a size of 1 px
    sizes: Array1  # (s,) px, root mean squares that are weighed
    odds: Array1  # (s,) logarithms of their probabilities

    def at(self, size: float) -> Shared:
        """Return the shared errors with one size (px), which is known."""
        return self._replace(sizes=np.array([size]), odds=np.zeros(1))


@entry
def smooth_columns(by_motion: Array3, rays: Array2, bend: Array2) -> Array:
    """Return shifts (n,2,q) px of points by each coefficient of a smooth error of 1 px.

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
    """Return places (n,3) in image and depth, at most 1; depths relative to the scene."""
    places, low, high = np.empty((len(rays), 3)), np.full(5, np.inf), np.full(5, -np.inf)
    each = np.empty(5)
    for i in range(len(rays)):
        x, y = rays[i]
        turn = move = 0.0
        for side in range(2):
            for axis in range(3):
                turn += by_motion[i, side, TURN.start + axis] ** 2
                move += by_motion[i, side, MOVE.start + axis] ** 2
        # The displacement by a rotation does not depend on the depth.
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
    """Return functions (n,b) of the points' places with root mean square ``size`` (m)."""
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
def smooth_error(lines: Lines, chosen: BoolArray1, bend: Array2, size: float) -> Shared:
    """Return the smooth error at the chosen points (n,), as orthogonal columns.

    Args:
        bend: (n,b), or (n,0): see :func:`smooth_columns`.
        size: px; its logarithm is known with a deviation of 1.
    """
    columns = smooth_columns(lines.by_motion[chosen], lines.image[chosen], bend[chosen])
    flat = columns.reshape(2 * len(columns), -1)
    of_image = bend.shape[1] == 0  # u and v have the same functions
    if of_image:
        flat = np.ascontiguousarray(columns[:, 0, :TERMS])
    values, axes = np.linalg.eigh(flat.T @ flat)
    kept = np.flatnonzero(values > _LEAST_SQUARE * max(values[-1], 1e-300))
    squares = values[kept]
    rows = flat @ np.ascontiguousarray(axes[:, kept]) / np.sqrt(squares)
    if of_image:
        rows, squares = np.kron(rows, np.eye(2)), np.repeat(squares, 2)
    return Shared(rows, squares, size * np.exp(_SIZES), _ODDS.copy())


def nothing_shared(count: int) -> Shared:
    """Return the shared errors of so many points if there are none."""
    return Shared(np.zeros((2 * count, 1)), np.zeros(1), np.zeros(1), np.zeros(1))
