"""Reprojection errors of many points under one motion, and their normal equations.

Points lie ``LANES`` at a time in the lanes, see :func:`pack`; a motion (model B of
:mod:`rs_localizer.core.shutter`) is a state of 18 numbers: rotation (9, row-major), translation,
angular velocity, linear velocity.

The error of a point is measured where the model puts it on the image, although the model is
evaluated at the *measured* row: noise of the row is noise of the time. With ``m`` the velocity of
the image point in pixels per unit of row time, ``g`` the gradient of the row time by the pixel and
``e`` the error at the measured row time, the point that satisfies its own row time lies at
``(I - m g^T)^-1 e`` to first order, and there the noise is that of the pixels. From a row time
``d`` later than the measured one the error is ``(I - m g^T)^-1 (e - m d)``: a second look at the
row that the first one found leaves out terms of third order only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from rs_localizer.core.jit import kernel
from rs_localizer.core.simd import LANES, Lanes, Vector, cross, dot, multiply, select, traced
from rs_localizer.core.so3 import Array

STATE_SIZE = 18
PARAMETERS = 12  # camera turn, camera position, angular, linear velocity (Estimate.covariance)

_POINT = 11  # X (3), ray (2), row time, pixel by ray (4), weight
_UNIFORM = STATE_SIZE + 4  # state, row time by pixel (2), squared scale, softness
_SUMS = PARAMETERS * (PARAMETERS + 1) // 2 + PARAMETERS + 1  # information, gradient, cost

# Terms of the power series; exact to double precision up to a turn of 90 degrees per half readout.
_SERIES_TERMS = 10
# Where the image point nearly keeps pace with the rows, no row or any row sees it: such a motion
# explains whatever was measured, and explains nothing.
_LEAST_PACE = 0.1
# The second look is taken no farther away than this, in row time.
_FARTHEST_LOOK = 0.1


def _series(x: Any, first_factorial: int) -> Any:
    """``sum_k (-x)^k / (2 k + first_factorial)!`` by Horner's rule."""
    total: Any = 0.0
    for k in reversed(range(_SERIES_TERMS)):
        total = total * x + (-1.0) ** k / math.factorial(2 * k + first_factorial)
    return total


def _outer_turn(theta: Vector, s: Any, c: Any) -> list[Vector]:
    """Rotation matrix of the rotation vector theta with its coefficients."""
    x, y, z = theta
    cx, cy, cz = c * x, c * y, c * z
    return [
        [1.0 - cy * y - cz * z, cx * y - s * z, cx * z + s * y],
        [cx * y + s * z, 1.0 - cx * x - cz * z, cy * z - s * x],
        [cx * z - s * y, cy * z + s * x, 1.0 - cx * x - cy * y],
    ]


class _View:
    """One point under one motion: everything that errors and derivatives share.

    ``looks``: the first look is at the measured row, a second one where the first saw the point.
    The measured row has the point's own noise in it, and derivatives taken there are correlated
    with the errors: harmless for a search, but where the points hardly determine the motion (a
    plane) it pulls the estimate by many times its deviation.
    """

    def __init__(self, values: Sequence[Lanes], looks: int) -> None:
        self.point, self._ray, self._measured_tau = values[0:3], values[3:5], values[5]
        self._raw_by_ray = [values[6:8], values[8:10]]
        self.weight = values[10]
        state = values[_POINT : _POINT + STATE_SIZE]
        self._omega, self._velocity = state[12:15], state[15:18]
        self._gradient = values[_POINT + STATE_SIZE : _POINT + STATE_SIZE + 2]
        self.scale, self.softness = values[_POINT + STATE_SIZE + 2 : _POINT + STATE_SIZE + 4]
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
        self.shifted = [a - tau * v for a, v in zip(self.at_middle, self._velocity, strict=True)]
        theta = [-(tau * w) for w in self._omega]
        self.angle_squared = dot(theta, theta)
        self.theta = theta
        self.c = _series(self.angle_squared, 2)
        self.turn = _outer_turn(theta, _series(self.angle_squared, 1), self.c)
        x, y, z = multiply(self.turn, self.shifted)
        in_front = z > 0.0
        # A zero in place of the inverse depth keeps points behind the camera finite and harmless.
        self.inverse_depth = select(in_front, 1.0 / z, 0.0)
        u, v = x * self.inverse_depth, y * self.inverse_depth
        self.image = [u, v]

        drift = multiply(self.turn, self._velocity)
        rate = [-(a + b) for a, b in zip(cross(self._omega, [x, y, z]), drift, strict=True)]
        ray_rate = [
            (rate[0] - u * rate[2]) * self.inverse_depth,
            (rate[1] - v * rate[2]) * self.inverse_depth,
        ]
        image_rate = multiply(self._raw_by_ray, ray_rate)
        self.pace = 1.0 - dot(self._gradient, image_rate)
        seen = in_front & (self.pace > _LEAST_PACE)
        divisor = select(self.pace > _LEAST_PACE, self.pace, _LEAST_PACE)
        lead = [a / divisor for a in image_rate]
        correction = [[lead[i] * self._gradient[j] for j in range(2)] for i in range(2)]
        correction[0][0] = correction[0][0] + 1.0
        correction[1][1] = correction[1][1] + 1.0
        self.by_ray = [
            [dot(correction[i], [self._raw_by_ray[0][j], self._raw_by_ray[1][j]]) for j in range(2)]
            for i in range(2)
        ]
        at_this_row = multiply(self.by_ray, [u - self._ray[0], v - self._ray[1]])
        offset = self._measured_tau - tau
        self.error = [a + b * offset for a, b in zip(at_this_row, lead, strict=True)]
        self.squared = select(seen, dot(self.error, self.error), math.inf)

    def robust(self) -> tuple[Any, Any]:
        """Weight and cost of the squared error: truncated (softness 0) or Tukey's (1)."""
        ratio = self.squared / self.scale
        inside = ratio < 1.0
        base = 1.0 - self.softness * select(inside, ratio, 0.0)
        weight = self.weight * select(inside, base * base, 0.0)
        third = self.scale / 3.0
        tukey = select(inside, third * (1.0 - base * base * base), third)
        truncated = select(inside, self.squared, self.scale)
        cost = self.softness * tukey + (1.0 - self.softness) * truncated
        return weight, self.weight * cost

    def jacobian(self) -> list[Vector]:
        """Derivatives of the error by the 12 parameters, two rows."""
        u, v = self.image
        alpha = [-x for x in self.theta]
        third = _series(self.angle_squared, 3)
        rows = []
        for p, q in self.by_ray:
            depth = self.inverse_depth
            by_camera_point = [p * depth, q * depth, -((p * u + q * v) * depth)]
            b = [dot(by_camera_point, [self.turn[i][j] for i in range(3)]) for j in range(3)]
            r = cross(b, self.shifted)
            r_alpha = cross(r, alpha)
            r_alpha2 = cross(r_alpha, alpha)
            by_omega = [
                self.tau * (x + self.c * y + third * z)
                for x, y, z in zip(r, r_alpha, r_alpha2, strict=True)
            ]
            rows.append(
                [*cross(b, self.at_middle), *[-x for x in b], *by_omega]
                + [-(self.tau * x) for x in b]
            )
        return rows


def _squared_error(values: list[Lanes]) -> Vector:
    return [_View(values, looks=2).squared]


def _pace(values: list[Lanes]) -> Vector:
    return [_View(values, looks=1).pace]


def _cost(values: list[Lanes]) -> Vector:
    return [_View(values, looks=1).robust()[1]]


def _accumulate(values: list[Lanes]) -> Vector:
    view = _View(values[: _POINT + _UNIFORM], looks=2)
    sums = values[_POINT + _UNIFORM :]
    weight, cost = view.robust()
    first, second = view.jacobian()
    weighted = [[weight * x for x in row] for row in (first, second)]
    totals: Vector = []
    k = 0
    for i in range(PARAMETERS):
        for j in range(i + 1):
            totals.append(sums[k] + weighted[0][i] * first[j] + weighted[1][i] * second[j])
            k += 1
    for i in range(PARAMETERS):
        totals.append(sums[k + i] + weighted[0][i] * view.error[0] + weighted[1][i] * view.error[1])
    totals.append(sums[-1] + cost)
    return totals


_squared_error_lanes = traced(_squared_error, _POINT, _UNIFORM)
_pace_lanes = traced(_pace, _POINT, _UNIFORM)
_cost_lanes = traced(_cost, _POINT, _UNIFORM)
_accumulate_lanes = traced(_accumulate, _POINT, _UNIFORM + _SUMS)


@kernel
def pack(points: Array, rays: Array, tau: Array, by_ray: Array) -> Array:
    """Points in lanes: (blocks, values, LANES) of points (n,3), rays (n,2), row times (n,) and
    derivatives of the pixel by the ray (n,2,2). The last block is filled up with weight zero.
    """
    count = len(points)
    blocks = (count + LANES - 1) // LANES
    data = np.empty((blocks, _POINT * LANES))
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
        uniform[(STATE_SIZE + 3) * LANES + lane] = softness


@kernel
def squared_errors(data: Array, count: int, state: Array, gradient: Array) -> Array:
    """Squared reprojection errors (count,) in raw pixels; infinite behind the camera."""
    uniform = np.empty(_UNIFORM * LANES)
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
    uniform = np.empty(_UNIFORM * LANES)
    spread_state(state, gradient, 1.0, 0.0, uniform)
    block_paces = np.empty(LANES)
    paces = np.empty(count)
    for block in range(len(data)):
        _pace_lanes(data[block], uniform, block_paces)
        for lane in range(min(LANES, count - block * LANES)):
            paces[block * LANES + lane] = block_paces[lane]
    return paces


@kernel
def robust_cost(
    data: Array, state: Array, gradient: Array, scale: float, softness: float, bound: float
) -> float:
    """Sum of the robust costs in squared pixels; stops early once it exceeds ``bound``."""
    uniform = np.empty(_UNIFORM * LANES)
    spread_state(state, gradient, scale, softness, uniform)
    block_costs = np.empty(LANES)
    total = 0.0
    for block in range(len(data)):
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
    information: Array,
    slope: Array,
) -> float:
    """Fill ``information`` (12,12) = J^T W J and ``slope`` (12,) = J^T W e; returns the cost."""
    uniform = np.zeros((_UNIFORM + _SUMS) * LANES)
    spread_state(state, gradient, scale, softness, uniform)
    sums = uniform[_UNIFORM * LANES :]
    for block in range(len(data)):
        _accumulate_lanes(data[block], uniform, sums)
    k = 0
    for i in range(PARAMETERS):
        for j in range(i + 1):
            total = 0.0
            for lane in range(LANES):
                total += sums[k * LANES + lane]
            information[i, j] = total
            information[j, i] = total
            k += 1
    for i in range(PARAMETERS):
        total = 0.0
        for lane in range(LANES):
            total += sums[k * LANES + lane]
        slope[i] = total
        k += 1
    cost = 0.0
    for lane in range(LANES):
        cost += sums[k * LANES + lane]
    return cost
