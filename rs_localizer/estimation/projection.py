# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Reprojection errors of many points under one motion, and their normal equations.

Points lie in lanes (:func:`rs_localizer.estimation.points.pack`); a motion is a state of
:mod:`rs_localizer.core.state`. Each point is seen by a camera of a rig. The motion of the rig takes
the point to its place ``Y`` before the rig at its row time. The camera, whose centre in the rig is
``c`` and whose axes are ``R``, sees it at ``R (Y - c)``. A single camera is its own rig.

The error of a point is measured at its modelled place on the image, although the model is evaluated
at the *measured* row: noise of the row is noise of the time. Let ``m`` be the velocity of the image
point in pixels per unit of row time, and ``e`` the error at the measured row time. Let ``g`` be the
gradient of the row time by the pixel. To first order the point that satisfies its own row time lies
at ``(I - m g^T)^-1 e``, where the noise is the noise of the pixels. From a row time ``d`` later
than the measured one the error is ``(I - m g^T)^-1 (e - m d)``: a second look at the row that the
first one found leaves out terms of third order only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, Array3, Out
from rs_localizer.core.blocks import write
from rs_localizer.core.simd.algebra import cross, dot, multiply
from rs_localizer.core.simd.tracing import LANES, Lanes, Vector, select, traced, traced_sums
from rs_localizer.core.state import MOTION_PARAMETERS, PARAMETERS, STATE_SIZE
from rs_localizer.native import entry, kernel

# X (3), ray (2), row time, pixel by ray (4), weight, row time by pixel (2); of the camera in its
# rig: its axes (9) and its centre (3)
POINT_SIZE = 25
WEIGHT, GRADIENT, AXES, CENTRE = 10, 11, 13, 22
# Behind them where the camera shakes: its turn (3) at the measured row, and the turn's rate (3).
SHAKE_SIZE = 6
UNIFORM_SIZE = STATE_SIZE + 3  # state, squared scale, its inverse, softness

# Terms of the power series; exact to double precision up to a turn of 90 degrees per half readout.
_SERIES_TERMS = 10
# If the image point nearly keeps pace with the rows, no row or any row sees it: such a motion would
# explain every measurement.
_LEAST_PACE = 0.1
# The second look is taken no farther away than this, in row time.
_FARTHEST_LOOK = 0.1


def _series(x: Any, first_factorial: int) -> Any:
    """Return ``sum_k (-x)^k / (2 k + first_factorial)!`` by Horner's rule."""
    total: Any = 0.0
    for k in reversed(range(_SERIES_TERMS)):
        total = total * x + (-1.0) ** k / math.factorial(2 * k + first_factorial)
    return total


def _outer_turn(theta: Vector, s: Any, c: Any) -> list[Vector]:
    """Return the rotation matrix of the rotation vector theta with its coefficients."""
    x, y, z = theta
    cx, cy, cz = c * x, c * y, c * z
    return [
        [1.0 - cy * y - cz * z, cx * y - s * z, cx * z + s * y],
        [cx * y + s * z, 1.0 - cx * x - cz * z, cy * z - s * x],
        [cx * z - s * y, cy * z + s * x, 1.0 - cx * x - cy * y],
    ]


class View:
    """One point under one motion: everything that errors and derivatives share.

    ``looks``: the first look is at the measured row, a second one where the first saw the point.
    The measured row has the point's own noise in it, and derivatives taken there are correlated
    with the errors: harmless for a search, but where the points hardly determine the motion (a
    plane) it pulls the estimate by many times its deviation. A search does without accelerations,
    too; the two go together.

    ``shaking``: behind the point stands what the camera turns beside the motion of the state.
    """

    def __init__(self, values: Sequence[Lanes], looks: int, shaking: bool = False) -> None:
        self.point, self._ray, self._measured_tau = values[0:3], values[3:5], values[5]
        self._raw_by_ray = [values[6:8], values[8:10]]
        self.weight = values[WEIGHT]
        self._gradient, self._axes = values[GRADIENT:AXES], _matrix(values[AXES:CENTRE])
        self._centre = values[CENTRE:POINT_SIZE]
        first = POINT_SIZE + (SHAKE_SIZE if shaking else 0)
        self._shake = values[POINT_SIZE:first]
        state = values[first : first + STATE_SIZE]
        self._omega, self._velocity = state[12:15], state[15:18]
        self._accelerating = looks > 1
        # Structural zeros cost nothing.
        accelerations: Vector = [*state[18:24]] if looks > 1 else [0.0] * 6
        self._alpha, self._acceleration = accelerations[:3], accelerations[3:]
        self.scale, self._inverse_scale, self.softness = values[first + STATE_SIZE :]
        moved = multiply([state[0:3], state[3:6], state[6:9]], self.point)
        self.at_middle = [a + b for a, b in zip(moved, state[9:12], strict=True)]
        self._look(self._measured_tau)
        for _ in range(1, looks):
            shift = dot(self._gradient, self.error)
            shift = select(shift < _FARTHEST_LOOK, shift, _FARTHEST_LOOK)
            shift = select(shift > -_FARTHEST_LOOK, shift, -_FARTHEST_LOOK)
            self._look(self._measured_tau + shift)

    def _look(self, tau: Any) -> None:
        self.tau = tau
        self._half_tau_squared = 0.5 * tau * tau
        self.shifted = [
            a - tau * v - self._half_tau_squared * q
            for a, v, q in zip(self.at_middle, self._velocity, self._acceleration, strict=True)
        ]
        theta = [
            -(tau * w) - self._half_tau_squared * a
            for w, a in zip(self._omega, self._alpha, strict=True)
        ]
        self.angle_squared = dot(theta, theta)
        self.theta = theta
        self.c = _series(self.angle_squared, 2)
        self.third = _series(self.angle_squared, 3)
        self.turn = _outer_turn(theta, _series(self.angle_squared, 1), self.c)
        self.rig_point = multiply(self.turn, self.shifted)
        offset = self._measured_tau - tau
        if self._shake:
            self._shaken = self._shake_turn(offset)
            self.rig_point = multiply(self._shaken, self.rig_point)
        x, y, z = _seen(self.rig_point, self._axes, self._centre)
        in_front = z > 0.0
        # A zero in place of the inverse depth keeps points behind the camera finite and harmless.
        self.inverse_depth = select(in_front, 1.0 / z, 0.0)
        u, v = x * self.inverse_depth, y * self.inverse_depth
        self.image = [u, v]

        rate = multiply(self._axes, self._rate())
        ray_rate = [
            (rate[0] - u * rate[2]) * self.inverse_depth,
            (rate[1] - v * rate[2]) * self.inverse_depth,
        ]
        image_rate = multiply(self._raw_by_ray, ray_rate)
        pace = 1.0 - dot(self._gradient, image_rate)
        seen = in_front & (pace > _LEAST_PACE)
        divisor = select(pace > _LEAST_PACE, pace, _LEAST_PACE)
        lead = [a / divisor for a in image_rate]
        correction = [[lead[i] * self._gradient[j] for j in range(2)] for i in range(2)]
        correction[0][0] = correction[0][0] + 1.0
        correction[1][1] = correction[1][1] + 1.0
        self.by_ray = [
            [dot(correction[i], [self._raw_by_ray[0][j], self._raw_by_ray[1][j]]) for j in range(2)]
            for i in range(2)
        ]
        at_this_row = multiply(self.by_ray, [u - self._ray[0], v - self._ray[1]])
        self.error = [a + b * offset for a, b in zip(at_this_row, lead, strict=True)]
        self.squared = select(seen, dot(self.error, self.error), math.inf)

    def _rate(self) -> Vector:
        """Return the velocity of the point in the rig's axes, per unit of row time."""
        omega, velocity = self._omega, self._velocity
        if self._accelerating:
            now = [w + self.tau * a for w, a in zip(omega, self._alpha, strict=True)]
            # Body rate by the right Jacobian of the turn -theta.
            once = cross(self.theta, now)
            twice = cross(self.theta, once)
            omega = [
                n + self.c * p + self.third * q for n, p, q in zip(now, once, twice, strict=True)
            ]
            velocity = [v + self.tau * a for v, a in zip(velocity, self._acceleration, strict=True)]
        drift = multiply(self.turn, velocity)
        if self._shake:
            turned = multiply(self._shaken, omega)
            omega = [a + b for a, b in zip(turned, self._shake[3:6], strict=True)]
            drift = multiply(self._shaken, drift)
        return [a - b for a, b in zip(cross(self.rig_point, omega), drift, strict=True)]

    def _shake_turn(self, offset: Any) -> list[Vector]:
        """Turn of the camera beside its motion, this far from the measured row."""
        angle = [-(a - offset * b) for a, b in zip(self._shake[0:3], self._shake[3:6], strict=True)]
        squared = dot(angle, angle)
        return _outer_turn(angle, _series(squared, 1), _series(squared, 2))

    @property
    def truncated(self) -> Any:
        """Cost of the squared error, at most the squared scale."""
        return self.weight * select(self.squared < self.scale, self.squared, self.scale)

    def robust(self) -> tuple[Any, Any]:
        """Return root weight and cost of the error: truncated (softness 0) or Tukey's (1)."""
        ratio = self.squared * self._inverse_scale
        inside = ratio < 1.0
        base = 1.0 - self.softness * select(inside, ratio, 0.0)
        weight = self.weight * select(inside, base, 0.0)  # a point counts or does not: 1 or 0
        third = self.scale * (1.0 / 3.0)
        tukey = select(inside, third * (1.0 - base * base * base), third)
        cost = self.softness * (self.weight * tukey) + (1.0 - self.softness) * self.truncated
        return weight, cost

    def jacobian(self) -> list[Vector]:
        """Return derivatives of the error by the parameters, two rows: 12, with two looks 18."""
        alpha = [-x for x in self.theta]
        before_shake = self.turn
        rows = []
        for by_rig_point in self._by_rig_point():
            if self._shake:
                by_rig_point = _transposed(self._shaken, by_rig_point)
            b = _transposed(before_shake, by_rig_point)
            r = cross(b, self.shifted)
            r_alpha = cross(r, alpha)
            r_alpha2 = cross(r_alpha, alpha)
            by_angle = [
                x + self.c * y + self.third * z
                for x, y, z in zip(r, r_alpha, r_alpha2, strict=True)
            ]
            row = [*cross(b, self.at_middle), *[-x for x in b]]
            row += [self.tau * x for x in by_angle] + [-(self.tau * x) for x in b]
            if self._accelerating:
                row += [self._half_tau_squared * x for x in by_angle]
                row += [-(self._half_tau_squared * x) for x in b]
            rows.append(row)
        return rows

    def by_shake(self) -> list[Vector]:
        """Return derivatives of the error by a rotation (3) of the rig at this row."""
        return [cross(row, self.rig_point) for row in self._by_rig_point()]

    def _by_rig_point(self) -> list[Vector]:
        u, v = self.image
        depth = self.inverse_depth
        by_camera_point = [
            [p * depth, q * depth, -((p * u + q * v) * depth)] for p, q in self.by_ray
        ]
        return [_transposed(self._axes, row) for row in by_camera_point]


def _matrix(values: Sequence[Lanes]) -> list[Vector]:
    return [[*values[3 * i : 3 * i + 3]] for i in range(3)]


def _seen(rig_point: Vector, axes: list[Vector], centre: Sequence[Lanes]) -> Vector:
    """Return a point before a rig, in the axes of one of its cameras."""
    return multiply(axes, [a - b for a, b in zip(rig_point, centre, strict=True)])


def _transposed(matrix: list[Vector], vector: Vector) -> Vector:
    return [dot(vector, [matrix[i][j] for i in range(3)]) for j in range(3)]


# Blocks that stay in the fast caches at a time.
_CHUNK = 32


def _tiles(parameters: int) -> list[list[tuple[int, int]]]:
    """Return all pairs of columns, the last one the error, in tiles that fit registers."""
    columns = parameters + 1
    groups = [range(k, min(k + 4, columns)) for k in range(0, columns, 4)]
    if len(groups[-1]) == 1:
        groups[-2:] = [range(groups[-2].start, columns)]
    pairs = [(groups[a], groups[b]) for a in range(len(groups)) for b in range(a + 1)]
    return [[(i, j) for i in high for j in low if j <= i] for high, low in pairs]


# Contribution of a point to the normal equations: two rows of the weighted Jacobian, each with its
# weighted error as the last column, and the cost. With one look the 12 parameters of a search.
_ROWS_SIZE = 2 * (MOTION_PARAMETERS + 1) + 1
_CLOSER_ROWS_SIZE = 2 * (PARAMETERS + 1) + 1
_TILES, _CLOSER_TILES = _tiles(MOTION_PARAMETERS), _tiles(PARAMETERS)
_PAIRS = np.array([pair for tile in _TILES for pair in tile])
_CLOSER_PAIRS = np.array([pair for tile in _CLOSER_TILES for pair in tile])
# Values of :func:`linearized` for a point: twice the error, its derivatives by the parameters and
# by a rotation at its row; then its place on the image, and the row time.
_LINE = 1 + PARAMETERS + 3


def _squared_error(values: list[Lanes]) -> Vector:
    return [View(values, looks=2).squared]


def _cost(values: list[Lanes]) -> Vector:
    return [View(values, looks=1).truncated]


def _still_cost(values: list[Lanes]) -> Vector:
    """Return :attr:`View.truncated` of a camera at rest, which takes less."""
    point, ray, by_ray = values[0:3], values[3:5], [values[6:8], values[8:10]]
    state = values[POINT_SIZE : POINT_SIZE + STATE_SIZE]
    moved = multiply([state[0:3], state[3:6], state[6:9]], point)
    rig_point = [a + b for a, b in zip(moved, state[9:12], strict=True)]
    x, y, z = _seen(rig_point, _matrix(values[AXES:CENTRE]), values[CENTRE:POINT_SIZE])
    inverse_depth = 1.0 / z
    offset = [x * inverse_depth - ray[0], y * inverse_depth - ray[1]]
    error = multiply(by_ray, offset)
    squared, scale = dot(error, error), values[POINT_SIZE + STATE_SIZE]
    return [values[WEIGHT] * select((z > 0.0) & (squared < scale), squared, scale)]


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
def spread_state(state: Array, scale: float, softness: float, uniform: Array) -> None:
    """Write a state and the settings of the robust loss into all lanes."""
    for lane in range(LANES):
        for k in range(STATE_SIZE):
            uniform[k * LANES + lane] = state[k]
        uniform[STATE_SIZE * LANES + lane] = scale * scale
        uniform[(STATE_SIZE + 1) * LANES + lane] = 1.0 / (scale * scale)
        uniform[(STATE_SIZE + 2) * LANES + lane] = softness


@entry
def squared_errors(data: Array2, count: int, state: Array1) -> Array:
    """Return squared reprojection errors (count,) in raw pixels; infinite if behind."""
    uniform = np.empty(UNIFORM_SIZE * LANES)
    spread_state(state, 1.0, 0.0, uniform)
    block_errors = np.empty(LANES)
    errors = np.empty(count)
    for block in range(len(data)):
        _squared_error_lanes(data[block], uniform, block_errors)
        for lane in range(min(LANES, count - block * LANES)):
            errors[block * LANES + lane] = block_errors[lane]
    return errors


@entry
def truncated_cost(data: Array2, state: Array1, scale: float, bound: float) -> float:
    """Sum of the truncated squared errors, px^2; stops early once it exceeds ``bound``."""
    uniform = np.empty(UNIFORM_SIZE * LANES)
    spread_state(state, scale, 0.0, uniform)
    still = not np.any(state[12:])
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


@entry
def normal_equations(
    data: Array2, state: Array1, scale: float, softness: float, looks: int,
    information: Out[Array2], slope: Out[Array1],
) -> float:  # fmt: skip
    """Fill ``information`` (p,p) = J^T W J and ``slope`` (p,) = J^T W e; returns the cost.

    ``looks`` at each point's row, see :class:`rs_localizer.estimation.projection.View`: 1 for
    the 12 parameters of a search, 2 for all 18.
    """
    uniform = np.empty(UNIFORM_SIZE * LANES)
    spread_state(state, scale, softness, uniform)
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

    errors: Array2  # (n,2) px
    by_motion: Array3  # (n,2,18) derivatives by the parameters
    by_turn: Array3  # (n,2,3) and by a turn of the camera at this row alone
    tau: Array1  # (n,) row times
    image: Array2  # (n,2) where the motion sees them, as rays


@entry
def linearized(data: Array2, count: int, state: Array1, shake: Array2) -> Lines:
    """Linearize each point's error at a motion and the vibration beside it.

    Args:
        data: packed points, ``count`` of them; weights are ignored.
        state: (24,).
        shake: (count,6) the camera's turn at each measured row, in its own axes, and the rate.
    """
    uniform = np.empty(UNIFORM_SIZE * LANES)
    spread_state(state, 1.0, 0.0, uniform)
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
