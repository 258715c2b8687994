"""How the camera turned during the readout, as a gyroscope knows it.

The body rate is a natural cubic spline through the samples. Between two of them the camera turns by
``exp(-theta)``, with Magnus' series up to its second term (Blanes, Casas, Oteo, Ros, "The Magnus
expansion and some of its applications", 2009):

    theta(h) = I + I x M / h,   I = integral of omega,   M = integral of (t - h/2) omega

both in closed form for a cubic. The axes are those of the camera at each moment.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.lanes.jit import kernel
from rs_localizer.core.so3 import exp, exp_many

# Gauss' rule on the readout; the sum of the weights is its length.
_NODES, _WEIGHTS = (0.5 * x for x in np.polynomial.legendre.leggauss(5))


@dataclass(frozen=True, slots=True, eq=False)
class KnownTurn:
    """The camera's turn beside the motion that its points are to tell.

    Times are row times, rates are body rates in rad per readout, along the camera axes of then.
    """

    tau: Array  # (k,) of the samples, increasing, k >= 2
    rates: Array  # (k-1,4,3) cubic of each interval, in powers of the time since its start
    rotations: Array  # (k,3,3) camera_then_from_camera_at_tau_0
    rate: Array  # (3,) at tau = 0, and its change (3,) there, per readout
    change: Array
    # (3,3) the parabola, in powers of tau, that is nearest to the rate over the readout
    parabola: Array
    roughness: float  # rad per readout, root mean square of what the parabola leaves
    # (6,6) of what the gyroscope is off by: a constant rate and its change, rad per readout and
    # per readout squared, along the axes at tau = 0
    error: Array = field(default_factory=lambda: np.zeros((6, 6)))
    rate_noise: float = 0.0  # rad per readout, of the rate at one moment
    delay: float = 0.0  # by how many readouts (standard deviation) all of it may be late or early

    @classmethod
    def of(
        cls,
        tau: Array,
        rates: Array,
        error: Array | None = None,
        rate_noise: float = 0.0,
        delay: float = 0.0,
    ) -> KnownTurn:
        """The turn of body rates (k,3), rad per readout, at row times (k,).

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
        """Rotation (3,3) camera_then_from_camera_at_tau_0 and body rate (3,) at ``tau``."""
        rotations, rates = self.at_rows(np.array([tau]))
        return rotations[0], rates[0]

    def at_rows(self, tau: Array) -> tuple[Array, Array]:
        """Rotations (n,3,3) and body rates (n,3) at row times (n,).

        Beyond the samples, where cubics would run away, the camera turns on at the mean rate.
        """
        times = np.ascontiguousarray(tau, dtype=np.float64)
        known = np.clip(times, self.tau[0], self.tau[-1])
        rotations, rates = turns_at(known, self.tau, self.rates, self.rotations)
        beyond = np.flatnonzero(times != known)
        if len(beyond):
            mean = self.parabola[0] + self.parabola[2] / 12.0
            on = exp_many((known - times)[beyond, None] * mean)
            rotations[beyond] = on @ rotations[beyond]
            rates[beyond] = mean
        return rotations, rates

    def late(self, tau: float) -> tuple[Array, Array]:
        """Turn (3,) and rate (3,) at ``tau`` that a delay of one readout would leave.

        What a motion under constant acceleration follows is told by the points and left out.
        """
        tau = min(max(tau, float(self.tau[0])), float(self.tau[-1]))
        _, rate = self.at(tau)
        powers = np.array([1.0, tau, tau * tau])
        slopes = np.array([0.0, 1.0, 2.0 * tau])
        return rate - powers @ self.parabola, (
            change_at(tau, self.tau, self.rates) - slopes @ self.parabola
        )


@kernel
def turn_of(tau: Array, rates: Array) -> tuple[Array, Array, Array, Array, Array, float]:
    """What a :class:`KnownTurn` holds of rates (k,3) at row times (k,)."""
    cubics = spline(tau, rates)
    rotations = rotations_at_knots(tau, cubics)
    found, squares = np.zeros((3, 3)), np.zeros(3)
    # Projections on Legendre polynomials by Gauss' rule of five nodes, exact up to degree 9.
    for node in range(5):
        x = 2.0 * _NODES[node]
        here = _rate_at(_NODES[node], tau, cubics)
        legendre = (1.0, x, 1.5 * x * x - 0.5)
        for degree in range(3):
            for axis in range(3):
                part = (2 * degree + 1) * _WEIGHTS[node] * legendre[degree] * here[axis]
                found[degree, axis] += part
        for axis in range(3):
            squares[axis] += _WEIGHTS[node] * here[axis] * here[axis]
    parabola = np.empty((3, 3))
    parabola[0] = found[0] - 0.5 * found[2]
    parabola[1] = 2.0 * found[1]
    parabola[2] = 6.0 * found[2]
    left = 0.0  # by Parseval
    for axis in range(3):
        left += squares[axis]
        for degree in range(3):
            left -= found[degree, axis] ** 2 / (2 * degree + 1)
    middle, change = _rate_at(0.0, tau, cubics), change_at(0.0, tau, cubics)
    return cubics, rotations, middle, change, parabola, np.sqrt(max(left, 0.0) / 3.0)


@kernel
def _rate_at(time: float, times: Array, cubics: Array) -> Array:
    place = _place(time, times)
    since = time - times[place]
    rate = np.empty(3)
    for axis in range(3):
        cubic = cubics[place]
        rate[axis] = cubic[0, axis] + since * (
            cubic[1, axis] + since * (cubic[2, axis] + since * cubic[3, axis])
        )
    return rate


@kernel
def change_at(time: float, times: Array, cubics: Array) -> Array:
    """Derivative (3,) of a spline of rates."""
    place = _place(time, times)
    since = time - times[place]
    change = np.empty(3)
    for axis in range(3):
        cubic = cubics[place]
        change[axis] = cubic[1, axis] + since * (
            2.0 * cubic[2, axis] + 3.0 * since * cubic[3, axis]
        )
    return change


@kernel
def spline(times: Array, values: Array) -> Array:
    """Natural cubic spline (k-1,4,3) through values (k,3) at times (k,): powers from each start."""
    count = len(times)
    # Second derivatives by Thomas' algorithm; zero at both ends.
    second = np.zeros((count, 3))
    upper = np.zeros(count)
    for i in range(1, count - 1):
        before, after = times[i] - times[i - 1], times[i + 1] - times[i]
        pivot = 2.0 * (before + after) - before * upper[i - 1]
        upper[i] = after / pivot
        for axis in range(3):
            slope = (values[i + 1, axis] - values[i, axis]) / after
            slope -= (values[i, axis] - values[i - 1, axis]) / before
            second[i, axis] = (6.0 * slope - before * second[i - 1, axis]) / pivot
    for i in range(count - 2, 0, -1):
        for axis in range(3):
            second[i, axis] -= upper[i] * second[i + 1, axis]
    cubics = np.empty((count - 1, 4, 3))
    for i in range(count - 1):
        step = times[i + 1] - times[i]
        for axis in range(3):
            here, there = second[i, axis], second[i + 1, axis]
            cubics[i, 0, axis] = values[i, axis]
            slope = (values[i + 1, axis] - values[i, axis]) / step
            cubics[i, 1, axis] = slope - step * (2.0 * here + there) / 6.0
            cubics[i, 2, axis] = 0.5 * here
            cubics[i, 3, axis] = (there - here) / (6.0 * step)
    return cubics


@kernel
def _turn(cubic: Array, time: float) -> Array:
    """Rotation vector (3,) of the turn from the start of an interval to a time in it."""
    whole, moment = np.empty(3), np.empty(3)
    for axis in range(3):
        a, b, c, d = cubic[0, axis], cubic[1, axis], cubic[2, axis], cubic[3, axis]
        whole[axis] = time * (a + time * (b / 2.0 + time * (c / 3.0 + time * d / 4.0)))
        # Over the time, so that none is divided by.
        moment[axis] = time * time * ((b + time * c) / 12.0 + 0.075 * time * time * d)
    turn = np.empty(3)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        turn[i] = whole[i] + whole[j] * moment[k] - whole[k] * moment[j]
    return turn


@kernel
def _place(time: float, times: Array) -> int:
    """The interval that a time lies in; the first or the last of times outside."""
    place: int = 0
    while place < len(times) - 2 and times[place + 1] < time:
        place += 1
    return place


@kernel
def rotations_at_knots(times: Array, cubics: Array) -> Array:
    """Rotations (k,3,3), camera_then_from_camera_at_time_0, at the knots of a spline of rates."""
    count = len(times)
    rotations = np.empty((count, 3, 3))
    rotations[0] = np.eye(3)
    for i in range(count - 1):
        step = exp(-_turn(cubics[i], times[i + 1] - times[i]))
        rotations[i + 1] = multiplied(step, rotations[i])
    start = _place(0.0, times)
    middle = multiplied(exp(-_turn(cubics[start], -times[start])), rotations[start])
    back = middle.T.copy()
    for i in range(count):
        rotations[i] = multiplied(rotations[i], back)
    return rotations


@kernel
def turns_at(wanted: Array, times: Array, cubics: Array, rotations: Array) -> tuple[Array, Array]:
    """Rotations (n,3,3) and rates (n,3) at times (n,) of a spline of rates; see `KnownTurn`."""
    found, rates = np.empty((len(wanted), 3, 3)), np.empty((len(wanted), 3))
    for i in range(len(wanted)):
        place = _place(wanted[i], times)
        since = wanted[i] - times[place]
        found[i] = multiplied(exp(-_turn(cubics[place], since)), rotations[place])
        cubic = cubics[place]
        for axis in range(3):
            rates[i, axis] = cubic[0, axis] + since * (
                cubic[1, axis] + since * (cubic[2, axis] + since * cubic[3, axis])
            )
    return found, rates


@kernel
def multiplied(left: Array, right: Array) -> Array:
    """Product of two (3,3) matrices."""
    product = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            product[i, j] = (
                left[i, 0] * right[0, j] + left[i, 1] * right[1, j] + left[i, 2] * right[2, j]
            )
    return product
