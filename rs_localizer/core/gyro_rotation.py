# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rotation of the camera during the readout, as its gyroscope measured it.

The body rate is a natural cubic spline through the samples (:mod:`rs_localizer.core.rate_spline`).
It also maps image points to where a camera without that rotation would see them
(:func:`gyro_compensated`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, Array3
from rs_localizer.core.rate_spline import (
    change_at,
    place_of,
    rate_at,
    rate_in,
    rotations_at_knots,
    spline,
    turn_in,
    turn_on,
)
from rs_localizer.native import entry, kernel

# Gauss' rule on the readout; the sum of the weights is its length.
_NODES, _WEIGHTS = (0.5 * x for x in np.polynomial.legendre.leggauss(5))
_UNKNOWN = np.diag(np.full(3, np.inf))


@dataclass(frozen=True, slots=True, eq=False)
class GyroRotation:
    """The camera's rotation as its gyroscope measured it; points estimate the motion beside it.

    Times are row times. Rates are body rates in rad per readout, in the camera axes of the moment.
    """

    tau: Array  # (k,) of the samples, increasing, k >= 2
    rates: Array  # (k-1,4,3) cubic of each interval, in powers of the time since its start
    rotations: Array  # (k,3,3) camera_then_from_camera_at_tau_0
    rate: Array  # (3,) at tau = 0, and its change (3,) there, per readout
    change: Array
    # (3,3) the parabola, in powers of tau, that is nearest to the rate over the readout
    parabola: Array
    roughness: float  # rad per readout, root mean square of the rate minus the parabola
    # (6,6) covariance of the gyroscope's errors: a constant rate (rad per readout) and its change
    # (per readout squared), in the axes at tau = 0
    error: Array = field(default_factory=lambda: np.zeros((6, 6)))
    rate_noise: float = 0.0  # rad per readout, white noise of the rate
    delay: float = 0.0  # readouts, standard deviation of the stamps' common offset
    # (3,3) covariance of the rate without delay and noise, (rad per readout)^2; None: unknown
    rate_error: Array | None = None

    @classmethod
    def of(
        cls,
        tau: Array,
        rates: Array,
        error: Array | None = None,
        rate_noise: float = 0.0,
        delay: float = 0.0,
    ) -> GyroRotation:
        """Return the rotation with body rates (k,3), rad per readout, at row times (k,).

        Raises:
            ValueError: fewer than two samples, or times that do not increase.
        """
        tau = np.ascontiguousarray(tau, dtype=np.float64)
        rates = np.ascontiguousarray(rates, dtype=np.float64)
        if len(tau) < 2 or not np.all(np.diff(tau) > 0.0):
            raise ValueError(f"need two or more increasing times, got {len(tau)}")
        error = np.zeros((6, 6)) if error is None else error
        return cls(tau, *turn_of(tau, rates), error, rate_noise, delay)

    def at(self, tau: float) -> tuple[Array, Array]:
        """Return rotation (3,3) camera_then_from_camera_at_tau_0 and body rate (3,) at ``tau``."""
        rotations, rates = _turn_at_rows(np.array([tau], np.float64), *self.spline)
        return rotations[0], rates[0]

    def at_rows(self, tau: Array) -> tuple[Array, Array]:
        """Return the rotations (n,3,3) and body rates (n,3) at row times (n,).

        Beyond the samples, where cubics would run away, the camera turns on at the mean rate.
        """
        times = np.ascontiguousarray(tau, dtype=np.float64)
        turns: tuple[Array, Array] = _turn_at_rows(times, *self.spline)
        return turns

    @property
    def spline(self) -> tuple[Array, Array, Array, Array]:
        """The arguments of :func:`find_turn` behind the row time."""
        return self.tau, self.rates, self.rotations, self.parabola

    @property
    def numbers(self) -> Turning:
        """The fields, as a :class:`Turning` that kernels take."""
        error = _UNKNOWN if self.rate_error is None else self.rate_error
        return Turning(*self.spline, self.rate, self.change, self.delay, self.rate_noise, error)


class Turning(NamedTuple):
    """Fields of a :class:`GyroRotation` that kernels need."""

    tau: Array1
    rates: Array3
    rotations: Array3
    parabola: Array2
    rate: Array1
    change: Array1
    delay: float
    rate_noise: float
    rate_error: Array2  # infinite where it is not known


NO_TURN = Turning(
    np.array([-0.5, 0.5]), np.zeros((1, 4, 3)), np.stack([np.eye(3)] * 2), np.zeros((3, 3)),
    np.zeros(3), np.zeros(3), 0.0, 0.0, _UNKNOWN,
)  # fmt: skip
"""The rotation of a camera without a gyroscope: none."""


@kernel
def find_turn(
    wanted: float, times: Array, cubics: Array, rotations: Array, parabola: Array,
    rotation: Array, rate: Array,
) -> None:  # fmt: skip
    """Fill in rotation and rate of a :class:`GyroRotation` at a row time."""
    inside = min(max(wanted, times[0]), times[-1])
    place = place_of(inside, times)
    since = inside - times[place]
    turn_on(turn_in(cubics[place], since), rotations[place], rotation)
    if inside == wanted:
        rate_in(cubics[place], since, rate)
        return
    for axis in range(3):
        rate[axis] = parabola[0, axis] + parabola[2, axis] / 12.0
    on = wanted - inside
    turn_on((on * rate[0], on * rate[1], on * rate[2]), rotation.copy(), rotation)


@entry
def _turn_at_rows(
    wanted: Array1, times: Array1, cubics: Array3, rotations: Array3, parabola: Array2
) -> tuple[Array, Array]:
    turns, rates = np.empty((len(wanted), 3, 3)), np.empty((len(wanted), 3))
    for i in range(len(wanted)):
        find_turn(wanted[i], times, cubics, rotations, parabola, turns[i], rates[i])
    return turns, rates


@entry
def late_at(tau: float, times: Array1, cubics: Array3, parabola: Array2) -> tuple[Array, Array]:
    """Return the rotation (3,) and rate (3,) that a delay of one readout leaves at a row time.

    The part that a constant acceleration can follow is left out: points determine it.
    """
    time = min(max(tau, times[0]), times[-1])
    rate, change = rate_at(time, times, cubics), change_at(time, times, cubics)
    for axis in range(3):
        constant, linear, square = parabola[0, axis], parabola[1, axis], parabola[2, axis]
        rate[axis] -= constant + time * (linear + time * square)
        change[axis] -= linear + 2.0 * time * square
    return rate, change


@entry
def turn_of(tau: Array1, rates: Array2) -> tuple[Array, Array, Array, Array, Array, float]:
    """Return the fields of a :class:`GyroRotation` with rates (k,3) at row times (k,)."""
    cubics = spline(tau, rates)
    rotations = rotations_at_knots(tau, cubics)
    moments, squares = np.zeros((3, 3)), np.zeros(3)
    # Projections on Legendre polynomials by Gauss' rule of five nodes, exact up to degree 9.
    for node in range(5):
        x = 2.0 * _NODES[node]
        here = rate_at(_NODES[node], tau, cubics)
        legendre = (1.0, x, 1.5 * x * x - 0.5)
        for degree in range(3):
            for axis in range(3):
                part = (2 * degree + 1) * _WEIGHTS[node] * legendre[degree] * here[axis]
                moments[degree, axis] += part
        for axis in range(3):
            squares[axis] += _WEIGHTS[node] * here[axis] * here[axis]
    parabola = np.empty((3, 3))
    for axis in range(3):
        parabola[0, axis] = moments[0, axis] - 0.5 * moments[2, axis]
        parabola[1, axis] = 2.0 * moments[1, axis]
        parabola[2, axis] = 6.0 * moments[2, axis]
    rest = 0.0  # by Parseval
    for axis in range(3):
        rest += squares[axis]
        for degree in range(3):
            rest -= moments[degree, axis] ** 2 / (2 * degree + 1)
    middle, change = rate_at(0.0, tau, cubics), change_at(0.0, tau, cubics)
    return cubics, rotations, middle, change, parabola, np.sqrt(max(rest, 0.0) / 3.0)


# Image points that nearly keep pace with the rows.
_LEAST_PACE = 0.1
# Bearings that the rotation moves behind the image plane have no image point.
_LEAST_FRONT = 1e-3


def gyro_compensated(
    rays: Array, tau: Array, by_ray: Array, gradient: Array, turn: GyroRotation
) -> tuple[Array, Array]:
    """Return bearings (n,2) without a known rotation, and derivatives (n,2,2) of pixels by them.

    Row by row the bearings are turned back into the axes of the middle row, so that all that
    follows sees a camera that hardly turns. A point's row is measured with its pixel, and with it
    the turn: of the pixels' noise ``n`` the model explains ``m g^T n``, where ``g`` is the gradient
    of the row time and ``m`` the velocity of the image point (:mod:`.estimation.projection`). The
    part ``k`` of ``m`` that is the known turn's is taken care of here, because

        I - (k + m) g^T = (I - k g^T) (I - m' g^T),   m' = (I - k g^T)^-1 m

    so that derivatives of the pixel by the compensated bearing times ``(I - k g^T)^-1`` are all
    that the kernels need.

    Args:
        rays: (n,2) as measured; NaN stays NaN.
        tau: (n,) row times.
        by_ray: (n,2,2) derivatives of the raw pixels by the rays.
        gradient: (2,) of the row time by the pixel.
    """
    compensated: tuple[Array, Array] = _gyro_compensated(rays, tau, by_ray, gradient, *turn.spline)
    return compensated


@entry
def _gyro_compensated(
    rays: Array2, tau: Array1, by_ray: Array3, gradient: Array1,
    times: Array1, cubics: Array3, rotations: Array3, parabola: Array2,
) -> tuple[Array, Array]:  # fmt: skip
    count = len(rays)
    turned, by_turned = np.empty((count, 2)), np.empty((count, 2, 2))
    rotation, rate = np.empty((3, 3)), np.empty(3)
    step, pixel, moved = np.empty((2, 2)), np.empty((2, 2)), np.empty(2)
    for i in range(count):
        x, y = rays[i, 0], rays[i, 1]
        if not np.isfinite(x + y + tau[i]):
            turned[i] = np.nan
            by_turned[i] = np.nan
            continue
        find_turn(tau[i], times, cubics, rotations, parabola, rotation, rate)
        # The bearing in the axes of the middle row.
        u = rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0]
        v = rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1]
        w = rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2]
        if not w > _LEAST_FRONT:
            turned[i] = np.nan
            by_turned[i] = np.nan
            continue
        turned[i, 0], turned[i, 1] = u / w, v / w
        # The ray by the compensated one.
        for j in range(2):
            step[0, j] = w * (rotation[0, j] - x * rotation[2, j])
            step[1, j] = w * (rotation[1, j] - y * rotation[2, j])
        # Velocity of the image point by the turn alone: the point moves by -rate x (x, y, 1).
        depth_rate = rate[1] * x - rate[0] * y
        ray_rate_x = rate[2] * y - rate[1] - x * depth_rate
        ray_rate_y = rate[0] - rate[2] * x - y * depth_rate
        for row in range(2):
            moved[row] = by_ray[i, row, 0] * ray_rate_x + by_ray[i, row, 1] * ray_rate_y
            for j in range(2):
                pixel[row, j] = by_ray[i, row, 0] * step[0, j] + by_ray[i, row, 1] * step[1, j]
        pace = max(1.0 - gradient[0] * moved[0] - gradient[1] * moved[1], _LEAST_PACE)
        for row in range(2):
            for j in range(2):
                along = gradient[0] * pixel[0, j] + gradient[1] * pixel[1, j]
                by_turned[i, row, j] = pixel[row, j] + moved[row] / pace * along
    return turned, by_turned
