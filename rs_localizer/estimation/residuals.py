"""Reprojection errors of many points under one motion, and their normal equations.

Points lie in lanes (:mod:`rs_localizer.estimation.packing`); a motion is a state of
:mod:`rs_localizer.core.state`. What a point's error is stands in
:mod:`rs_localizer.estimation.view`.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.blocks import write
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.simd.tracing import LANES, Lanes, Vector, traced, traced_sums
from rs_localizer.core.state import MOTION_PARAMETERS, PARAMETERS, STATE_SIZE
from rs_localizer.estimation.view import POINT_SIZE, SHAKE_SIZE, UNIFORM_SIZE, View, still_cost

# So many blocks at a time stay in the fast caches.
_CHUNK = 32


def _tile(higher: range, lower: range) -> list[tuple[int, int]]:
    return [(i, j) for i in higher for j in lower if j <= i]


def _tiles(parameters: int) -> list[list[tuple[int, int]]]:
    """All pairs of columns, the last of which is the error, in tiles whose sums fit registers."""
    columns = parameters + 1
    groups = [range(k, min(k + 4, columns)) for k in range(0, columns, 4)]
    if len(groups[-1]) == 1:
        groups[-2:] = [range(groups[-2].start, columns)]
    return [_tile(groups[a], groups[b]) for a in range(len(groups)) for b in range(a + 1)]


# What a point gives to the normal equations: two rows of the weighted Jacobian, each with its
# weighted error as the last column, and the cost. With one look the 12 parameters of a search.
_ROWS_SIZE = 2 * (MOTION_PARAMETERS + 1) + 1
_CLOSER_ROWS_SIZE = 2 * (PARAMETERS + 1) + 1
_TILES, _CLOSER_TILES = _tiles(MOTION_PARAMETERS), _tiles(PARAMETERS)
_PAIRS = np.array([pair for tile in _TILES for pair in tile])
_CLOSER_PAIRS = np.array([pair for tile in _CLOSER_TILES for pair in tile])
# What :func:`linearized` says of a point: twice the error, its derivatives by the parameters and by
# a turn at its row; where on the image it is seen, and the row time.
_LINE = 1 + PARAMETERS + 3


def _squared_error(values: list[Lanes]) -> Vector:
    return [View(values, looks=2).squared]


def _pace(values: list[Lanes]) -> Vector:
    return [View(values, looks=2).pace]


def _cost(values: list[Lanes]) -> Vector:
    return [View(values, looks=1).truncated]


def _still_cost(values: list[Lanes]) -> Vector:
    return [still_cost(values)]


def _rows(looks: int, values: list[Lanes]) -> Vector:
    view = View(values, looks)
    weight, cost = view.robust()
    rows = zip(view.jacobian(), view.error, strict=True)
    return [weight * x for row, error in rows for x in (*row, error)] + [cost]


def _lines(values: list[Lanes]) -> Vector:
    view = View(values, looks=2, shaking=True)
    lines = zip(view.error, view.jacobian(), view.by_shake(), strict=True)
    return [x for error, row, turn in lines for x in (error, *row, *turn)] + [*view.image, view.tau]


def _products(columns: int, tile: list[tuple[int, int]], values: list[Lanes]) -> Vector:
    first, second = values[:columns], values[columns : 2 * columns]
    return [first[i] * first[j] + second[i] * second[j] for i, j in tile]


def _last(values: list[Lanes]) -> Vector:
    return [values[-1]]


_squared_error_lanes = traced(_squared_error, POINT_SIZE, UNIFORM_SIZE)
_pace_lanes = traced(_pace, POINT_SIZE, UNIFORM_SIZE)
_cost_lanes = traced(_cost, POINT_SIZE, UNIFORM_SIZE)
_still_cost_lanes = traced(_still_cost, POINT_SIZE, UNIFORM_SIZE)
_rows_lanes = traced(partial(_rows, 1), POINT_SIZE, UNIFORM_SIZE)
_closer_rows_lanes = traced(partial(_rows, 2), POINT_SIZE, UNIFORM_SIZE)
_lines_lanes = traced(_lines, POINT_SIZE + SHAKE_SIZE, UNIFORM_SIZE)


def _summing(parameters: int, tiles: list[list[tuple[int, int]]]) -> Any:
    parts = [(partial(_products, parameters + 1, tile), len(tile)) for tile in tiles]
    return traced_sums(2 * (parameters + 1) + 1, *parts, (_last, 1))


_sums = _summing(MOTION_PARAMETERS, _TILES)
_closer_sums = _summing(PARAMETERS, _CLOSER_TILES)


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
def truncated_cost(data: Array, state: Array, gradient: Array, scale: float, bound: float) -> float:
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
    """Fill ``information`` (p,p) = J^T W J and ``slope`` (p,) = J^T W e; returns the cost.

    ``looks`` at each point's row, see :class:`rs_localizer.estimation.view.View`: 1 for the 12
    parameters of a search, 2 for all 18.
    """
    uniform = np.empty(UNIFORM_SIZE * LANES)
    spread_state(state, gradient, scale, softness, uniform)
    pairs = _PAIRS if looks == 1 else _CLOSER_PAIRS
    size = _ROWS_SIZE if looks == 1 else _CLOSER_ROWS_SIZE
    rows = np.empty((_CHUNK, size * LANES))
    sums = np.empty(len(pairs) + 1)
    totals = np.zeros(len(pairs) + 1)
    for start in range(0, len(data), _CHUNK):
        count = min(_CHUNK, len(data) - start)
        for block in range(count):
            if looks == 1:
                _rows_lanes(data[start + block], uniform, rows[block])
            else:
                _closer_rows_lanes(data[start + block], uniform, rows[block])
        if looks == 1:
            _sums(rows, count, sums)
        else:
            _closer_sums(rows, count, sums)
        totals += sums
    parameters = len(slope)
    for k in range(len(pairs)):
        i, j = pairs[k, 0], pairs[k, 1]
        if i < parameters:
            information[i, j] = totals[k]
            information[j, i] = totals[k]
        elif j < parameters:
            slope[j] = totals[k]
    cost: float = totals[-1]
    return cost


class Lines(NamedTuple):
    """The points of an image, linearized at a motion."""

    errors: Array  # (n,2) px
    by_motion: Array  # (n,2,18) derivatives by the parameters
    by_turn: Array  # (n,2,3) and by a turn of the camera at this row alone
    tau: Array  # (n,) row times
    image: Array  # (n,2) where the motion sees them, as rays


@kernel
def linearized(data: Array, count: int, state: Array, gradient: Array, shake: Array) -> Lines:
    """Each point's error and its derivatives at a motion and what the camera turns beside it.

    Args:
        data: packed points, ``count`` of them; weights are ignored.
        state, gradient: as above.
        shake: (count,6) the camera's turn at each measured row, in its own axes, and the rate.
    """
    uniform = np.empty(UNIFORM_SIZE * LANES)
    spread_state(state, gradient, 1.0, 0.0, uniform)
    block_data = np.zeros((POINT_SIZE + SHAKE_SIZE) * LANES)
    lines = np.empty((2 * _LINE + 3) * LANES)
    errors, by_motion = np.empty((count, 2)), np.empty((count, 2, PARAMETERS))
    by_turn, tau, image = np.empty((count, 2, 3)), np.empty(count), np.empty((count, 2))
    for block in range(len(data)):
        first = block * LANES
        write(block_data[: POINT_SIZE * LANES], data[block])
        here = min(LANES, count - first)
        for lane in range(here):
            for k in range(SHAKE_SIZE):
                block_data[(POINT_SIZE + k) * LANES + lane] = shake[first + lane, k]
        _lines_lanes(block_data, uniform, lines)
        for lane in range(here):
            i = first + lane
            for row in range(2):
                at = row * _LINE
                errors[i, row] = lines[at * LANES + lane]
                for k in range(PARAMETERS):
                    by_motion[i, row, k] = lines[(at + 1 + k) * LANES + lane]
                for k in range(3):
                    by_turn[i, row, k] = lines[(at + 1 + PARAMETERS + k) * LANES + lane]
                image[i, row] = lines[(2 * _LINE + row) * LANES + lane]
            tau[i] = lines[(2 * _LINE + 2) * LANES + lane]
    return Lines(errors, by_motion, by_turn, tau, image)
