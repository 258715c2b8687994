"""One point under one motion: its reprojection error and the derivatives, lane by lane.

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

from rs_localizer.core.simd.algebra import cross, dot, multiply
from rs_localizer.core.simd.tracing import Lanes, Vector, select
from rs_localizer.core.state import STATE_SIZE

POINT_SIZE = 11  # X (3), ray (2), row time, pixel by ray (4), weight
# Behind them where the camera shakes: its turn (3) at the measured row, and the turn's rate (3).
SHAKE_SIZE = 6
UNIFORM_SIZE = STATE_SIZE + 5  # state, row time by pixel (2), squared scale, its inverse, softness

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
        self.weight = values[10]
        first = POINT_SIZE + (SHAKE_SIZE if shaking else 0)
        self._shake = values[POINT_SIZE:first]
        state = values[first : first + STATE_SIZE]
        self._omega, self._velocity = state[12:15], state[15:18]
        self._accelerating = looks > 1
        # Structural zeros cost nothing.
        accelerations: Vector = [*state[18:24]] if looks > 1 else [0.0] * 6
        self._alpha, self._acceleration = accelerations[:3], accelerations[3:]
        self._gradient = values[first + STATE_SIZE : first + STATE_SIZE + 2]
        self.scale, self._inverse_scale, self.softness = values[first + STATE_SIZE + 2 :]
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
        seen_from = multiply(self.turn, self.shifted)
        offset = self._measured_tau - tau
        if self._shake:
            self._shaken = self._shake_turn(offset)
            seen_from = multiply(self._shaken, seen_from)
        self.camera_point = seen_from
        x, y, z = seen_from
        in_front = z > 0.0
        # A zero in place of the inverse depth keeps points behind the camera finite and harmless.
        self.inverse_depth = select(in_front, 1.0 / z, 0.0)
        u, v = x * self.inverse_depth, y * self.inverse_depth
        self.image = [u, v]

        rate = self._rate([x, y, z])
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
        self.error = [a + b * offset for a, b in zip(at_this_row, lead, strict=True)]
        self.squared = select(seen, dot(self.error, self.error), math.inf)

    def _rate(self, camera_point: Vector) -> Vector:
        """Velocity of the point in the camera axes, per unit of row time."""
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
        return [-(a + b) for a, b in zip(cross(omega, camera_point), drift, strict=True)]

    def _shake_turn(self, offset: Any) -> list[Vector]:
        """By how much the camera is turned beside its motion, this far from the measured row."""
        angle = [-(a - offset * b) for a, b in zip(self._shake[0:3], self._shake[3:6], strict=True)]
        squared = dot(angle, angle)
        return _outer_turn(angle, _series(squared, 1), _series(squared, 2))

    @property
    def truncated(self) -> Any:
        """Cost of the squared error, at most the squared scale."""
        return self.weight * select(self.squared < self.scale, self.squared, self.scale)

    def robust(self) -> tuple[Any, Any]:
        """Root of the weight, and cost, of the error: truncated (softness 0) or Tukey's (1)."""
        ratio = self.squared * self._inverse_scale
        inside = ratio < 1.0
        base = 1.0 - self.softness * select(inside, ratio, 0.0)
        weight = self.weight * select(inside, base, 0.0)  # a point counts or does not: 1 or 0
        third = self.scale * (1.0 / 3.0)
        tukey = select(inside, third * (1.0 - base * base * base), third)
        cost = self.softness * (self.weight * tukey) + (1.0 - self.softness) * self.truncated
        return weight, cost

    def jacobian(self) -> list[Vector]:
        """Derivatives of the error by the parameters, two rows: 12, and with two looks 18."""
        alpha = [-x for x in self.theta]
        before_shake = self.turn
        rows = []
        for by_camera_point in self._by_camera_point():
            if self._shake:
                by_camera_point = _transposed(self._shaken, by_camera_point)
            b = _transposed(before_shake, by_camera_point)
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
        """Derivatives of the error by a turn (3) of the camera in its own axes at this row."""
        return [cross(row, self.camera_point) for row in self._by_camera_point()]

    def _by_camera_point(self) -> list[Vector]:
        u, v = self.image
        depth = self.inverse_depth
        return [[p * depth, q * depth, -((p * u + q * v) * depth)] for p, q in self.by_ray]


def _transposed(matrix: list[Vector], vector: Vector) -> Vector:
    return [dot(vector, [matrix[i][j] for i in range(3)]) for j in range(3)]


def still_cost(values: Sequence[Lanes]) -> Any:
    """:attr:`View.truncated` of a camera at rest, for which there is less to compute."""
    point, ray, by_ray = values[0:3], values[3:5], [values[6:8], values[8:10]]
    state = values[POINT_SIZE : POINT_SIZE + STATE_SIZE]
    moved = multiply([state[0:3], state[3:6], state[6:9]], point)
    x, y, z = (a + b for a, b in zip(moved, state[9:12], strict=True))
    inverse_depth = 1.0 / z
    offset = [x * inverse_depth - ray[0], y * inverse_depth - ray[1]]
    error = multiply(by_ray, offset)
    squared, scale = dot(error, error), values[POINT_SIZE + STATE_SIZE + 2]
    return values[10] * select((z > 0.0) & (squared < scale), squared, scale)
