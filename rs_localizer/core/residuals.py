"""Reprojection errors of many points under one motion, and their normal equations.

Points lie ``LANES`` at a time in the lanes, see :func:`pack`; a motion (model B of
:mod:`rs_localizer.core.shutter`) is a state of 18 numbers: rotation (9, row-major), translation,
angular velocity, linear velocity. What a point's error is stands in :mod:`rs_localizer.core.view`.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from rs_localizer.core.jit import kernel
from rs_localizer.core.simd import LANES, Lanes, Vector, traced, traced_sums
from rs_localizer.core.so3 import Array
from rs_localizer.core.view import (
    PARAMETERS,
    POINT_SIZE,
    STATE_SIZE,
    UNIFORM_SIZE,
    View,
    still_cost,
)

# What a point gives to the normal equations: two rows of the weighted Jacobian, each with its
# weighted error as the last column, and the cost.
_COLUMNS = PARAMETERS + 1
_ROWS_SIZE = 2 * _COLUMNS + 1
# So many blocks at a time stay in the fast caches.
_CHUNK = 32
# The products of all pairs of columns, in tiles whose sums fit the registers.
_GROUPS = (range(4), range(4, 8), range(8, _COLUMNS))


def _tile(higher: range, lower: range) -> list[tuple[int, int]]:
    return [(i, j) for i in higher for j in lower if j <= i]


_TILES = [_tile(_GROUPS[a], _GROUPS[b]) for a in range(len(_GROUPS)) for b in range(a + 1)]
_PAIRS = np.array([pair for tile in _TILES for pair in tile])


def _squared_error(values: list[Lanes]) -> Vector:
    return [View(values, looks=2).squared]


def _pace(values: list[Lanes]) -> Vector:
    return [View(values, looks=1).pace]


def _cost(values: list[Lanes]) -> Vector:
    return [View(values, looks=1).truncated]


def _still_cost(values: list[Lanes]) -> Vector:
    return [still_cost(values)]


def _rows(looks: int, values: list[Lanes]) -> Vector:
    view = View(values, looks)
    weight, cost = view.robust()
    rows = zip(view.jacobian(), view.error, strict=True)
    return [weight * x for row, error in rows for x in (*row, error)] + [cost]


def _products(tile: list[tuple[int, int]], values: list[Lanes]) -> Vector:
    first, second = values[:_COLUMNS], values[_COLUMNS : 2 * _COLUMNS]
    return [first[i] * first[j] + second[i] * second[j] for i, j in tile]


def _last(values: list[Lanes]) -> Vector:
    return [values[-1]]


_squared_error_lanes = traced(_squared_error, POINT_SIZE, UNIFORM_SIZE)
_pace_lanes = traced(_pace, POINT_SIZE, UNIFORM_SIZE)
_cost_lanes = traced(_cost, POINT_SIZE, UNIFORM_SIZE)
_still_cost_lanes = traced(_still_cost, POINT_SIZE, UNIFORM_SIZE)
_rows_lanes = traced(partial(_rows, 1), POINT_SIZE, UNIFORM_SIZE)
_closer_rows_lanes = traced(partial(_rows, 2), POINT_SIZE, UNIFORM_SIZE)
_sums = traced_sums(
    _ROWS_SIZE, *((partial(_products, tile), len(tile)) for tile in _TILES), (_last, 1)
)


@kernel
def pack(points: Array, rays: Array, tau: Array, by_ray: Array) -> Array:
    """Points in lanes: (blocks, values, LANES) of points (n,3), rays (n,2), row times (n,) and
    derivatives of the pixel by the ray (n,2,2). The last block is filled up with weight zero.
    """
    count = len(points)
    blocks = (count + LANES - 1) // LANES
    data = np.empty((blocks, POINT_SIZE * LANES))
    for block in range(blocks):
        row = data[block]
        for lane in range(LANES):
            i = min(block * LANES + lane, count - 1)
            for k in range(3):
                row[k * LANES + lane] = points[i, k]
            row[3 * LANES + lane] = rays[i, 0]
            row[4 * LANES + lane] = rays[i, 1]
            row[5 * LANES + lane] = tau[i]
            for k in range(4):
                row[(6 + k) * LANES + lane] = by_ray[i, k // 2, k % 2]
            row[10 * LANES + lane] = 1.0 if block * LANES + lane < count else 0.0
    return data


@kernel
def set_weights(data: Array, weights: Array) -> None:
    """Give the packed points their weights (n,): 1 or 0."""
    for i in range(len(weights)):
        data[i // LANES, 10 * LANES + i % LANES] = weights[i]


@kernel
def spread_state(
    state: Array, gradient: Array, scale: float, softness: float, uniform: Array
) -> None:
    """Write a state and the settings of the robust loss into all lanes."""
    for lane in range(LANES):
        for k in range(STATE_SIZE):
            uniform[k * LANES + lane] = state[k]
        uniform[STATE_SIZE * LANES + lane] = gradient[0]
        uniform[(STATE_SIZE + 1) * LANES + lane] = gradient[1]
        uniform[(STATE_SIZE + 2) * LANES + lane] = scale * scale
        uniform[(STATE_SIZE + 3) * LANES + lane] = 1.0 / (scale * scale)
        uniform[(STATE_SIZE + 4) * LANES + lane] = softness


@kernel
def squared_errors(data: Array, count: int, state: Array, gradient: Array) -> Array:
    """Squared reprojection errors (count,) in raw pixels; infinite behind the camera."""
    uniform = np.empty(UNIFORM_SIZE * LANES)
    spread_state(state, gradient, 1.0, 0.0, uniform)
    block_errors = np.empty(LANES)
    errors = np.empty(count)
    for block in range(len(data)):
        _squared_error_lanes(data[block], uniform, block_errors)
        for lane in range(min(LANES, count - block * LANES)):
            errors[block * LANES + lane] = block_errors[lane]
    return errors


@kernel
def row_paces(data: Array, count: int, state: Array, gradient: Array) -> Array:
    """How much faster than the image points the rows move (count,): 1 at rest, 0 in step."""
    uniform = np.empty(UNIFORM_SIZE * LANES)
    spread_state(state, gradient, 1.0, 0.0, uniform)
    block_paces = np.empty(LANES)
    paces = np.empty(count)
    for block in range(len(data)):
        _pace_lanes(data[block], uniform, block_paces)
        for lane in range(min(LANES, count - block * LANES)):
            paces[block * LANES + lane] = block_paces[lane]
    return paces


@kernel
def truncated_cost(
    data: Array, state: Array, gradient: Array, scale: float, bound: float
) -> float:
    """Sum of the truncated squared errors, px^2; stops early once it exceeds ``bound``."""
    uniform = np.empty(UNIFORM_SIZE * LANES)
    spread_state(state, gradient, scale, 0.0, uniform)
    still = True
    for k in range(12, STATE_SIZE):
        still = still and state[k] == 0.0
    block_costs = np.empty(LANES)
    total = 0.0
    for block in range(len(data)):
        if still:
            _still_cost_lanes(data[block], uniform, block_costs)
        else:
            _cost_lanes(data[block], uniform, block_costs)
        for lane in range(LANES):
            total += block_costs[lane]
        if not total < bound:
            break
    return total


@kernel
def normal_equations(
    data: Array,
    state: Array,
    gradient: Array,
    scale: float,
    softness: float,
    looks: int,
    information: Array,
    slope: Array,
) -> float:
    """Fill ``information`` (12,12) = J^T W J and ``slope`` (12,) = J^T W e; returns the cost.

    ``looks`` (1 or 2) at each point's row: see :class:`rs_localizer.core.view.View`.
    """
    uniform = np.empty(UNIFORM_SIZE * LANES)
    spread_state(state, gradient, scale, softness, uniform)
    rows = np.empty((_CHUNK, _ROWS_SIZE * LANES))
    sums = np.empty(len(_PAIRS) + 1)
    totals = np.zeros(len(_PAIRS) + 1)
    for start in range(0, len(data), _CHUNK):
        count = min(_CHUNK, len(data) - start)
        for block in range(count):
            if looks == 1:
                _rows_lanes(data[start + block], uniform, rows[block])
            else:
                _closer_rows_lanes(data[start + block], uniform, rows[block])
        _sums(rows, count, sums)
        totals += sums
    for k in range(len(_PAIRS)):
        i, j = _PAIRS[k, 0], _PAIRS[k, 1]
        if i < PARAMETERS:
            information[i, j] = totals[k]
            information[j, i] = totals[k]
        elif j < PARAMETERS:
            slope[j] = totals[k]
    cost: float = totals[-1]
    return cost
