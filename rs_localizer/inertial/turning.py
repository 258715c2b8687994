"""Turns of the camera by the gyroscope: within a frame, and from one to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.known_turn import (
    KnownTurn,
    multiplied,
    rotations_at_knots,
    spline,
    turn_of,
    turns_at,
)
from rs_localizer.core.lanes.jit import kernel
from rs_localizer.core.so3 import coefficients, log
from rs_localizer.inertial.band import densified
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.settings import SCALE_DEVIATION

PARAMETERS = 4
"""Of a gyroscope: its bias (3, rad/s), and the time offset of its stamps (s)."""
BIAS, OFFSET = slice(0, 3), 3

# The integral of white noise is a random walk. The least-squares parabola of one over an interval
# of length 1 has a slope and a curvature of these variances (by its Legendre coefficients).
_WALK_SLOPE, _WALK_CURVATURE = 6.0 / 5.0, 120.0 / 7.0


@dataclass(frozen=True, slots=True, eq=False)
class GyroscopeErrors:
    """What is known of a gyroscope's errors."""

    bias: Array  # (3,) rad/s, to be taken from its rates
    time_offset: float  # s, to be added to its times
    covariance: Array  # (4,4) of bias and time offset
    noise: float  # rad/s/sqrt(Hz)


@dataclass(frozen=True, slots=True, eq=False)
class TurnBetween:
    """The turn from one moment to another, and how it depends on what is not known."""

    rotation: Array  # (3,3) camera_then_from_camera_now
    # (3,4) of a turn of the camera then, in its own axes, by the gyroscope's parameters
    by_parameters: Array
    variance: float  # rad^2 of each axis, by noise and scale


@dataclass(frozen=True, slots=True, eq=False)
class TurnWithin:
    """The turn during a frame, and how what it leaves depends on what is not known.

    That is the rate and its change (6), per readout, along the axes of the middle row.
    """

    known: KnownTurn
    by_parameters: Array  # (6,4)
    variances: Array  # (6,) by noise and scale


def turn_within(
    samples: ImuSamples, middle_ns: int, readout_time: float, errors: GyroscopeErrors
) -> TurnWithin | None:
    """How the camera turns during a frame; None if the samples do not cover it.

    Args:
        middle_ns: exposure of the middle row.
        readout_time: s.
    """
    spanning = _spanning(samples, middle_ns, 0.5 * readout_time, 0.5 * readout_time, errors)
    if spanning is None:
        return None
    times, rates = spanning
    turn, error, by_parameters, variances = _within(
        times, rates, readout_time, errors.noise, errors.covariance
    )
    period = (times[-1] - times[0]) / (len(times) - 1)
    rate_noise = errors.noise * readout_time / math.sqrt(period)
    delay = math.sqrt(errors.covariance[OFFSET, OFFSET]) / readout_time
    return TurnWithin(KnownTurn(*turn, error, rate_noise, delay), by_parameters, variances)


def turn_between(
    samples: ImuSamples, from_ns: int, to_ns: int, errors: GyroscopeErrors
) -> TurnBetween | None:
    """How the camera turns from one moment to a later one; None if the samples do not cover it."""
    length = 1e-9 * (to_ns - from_ns)
    spanning = _spanning(samples, to_ns, length, 0.0, errors)
    if spanning is None:
        return None
    return TurnBetween(*_between(*spanning, length, errors.noise))


@kernel
def _within(
    times: Array, rates: Array, readout_time: float, noise: float, of_parameters: Array
) -> tuple[tuple[Array, Array, Array, Array, Array, Array], Array, Array, Array]:
    """The turn of a :class:`KnownTurn`, its error, and what :func:`_left_over` gives."""
    dense, found = densified(times, rates)
    tau = dense / readout_time
    cubics, rotations, rate, change, parabola = turn_of(tau, found * readout_time)
    by_parameters, variances = _left_over(tau, cubics, rotations, readout_time, noise)
    error = by_parameters @ of_parameters @ by_parameters.T
    for k in range(6):
        error[k, k] += variances[k]
    return (tau, cubics, rotations, rate, change, parabola), error, by_parameters, variances


@kernel
def _left_over(
    tau: Array, cubics: Array, rotations: Array, readout_time: float, noise: float
) -> tuple[Array, Array]:
    """Derivatives (6,4) of what a known turn leaves by the parameters, and its variances (6,)."""
    ends, rates = turns_at(np.array([-0.5, 0.0, 0.5]), tau, cubics, rotations)
    by_parameters = np.zeros((6, PARAMETERS))
    variances = np.empty(6)
    whole = log(multiplied(ends[2], ends[0].T.copy()))
    turned, changed = 0.0, 0.0
    for k in range(3):
        by_parameters[k, k] = -readout_time
        # Samples of later times: each row has the rate of a little earlier.
        change = rates[2, k] - rates[0, k]
        bend = 4.0 * (rates[0, k] - 2.0 * rates[1, k] + rates[2, k])
        by_parameters[k, OFFSET] = -change / readout_time
        by_parameters[3 + k, OFFSET] = -bend / readout_time
        turned += whole[k] * whole[k]
        changed += change * change
    walk, scale = noise * noise * readout_time, SCALE_DEVIATION * SCALE_DEVIATION
    variances[:3] = _WALK_SLOPE * walk + scale * turned
    variances[3:] = _WALK_CURVATURE * walk + scale * changed
    return by_parameters, variances


@kernel
def _between(times: Array, rates: Array, length: float, noise: float) -> tuple[Array, Array, float]:
    """The fields of a :class:`TurnBetween`; it ends at time 0."""
    dense, found = densified(times, rates)
    cubics = spline(dense, found)
    rotations = rotations_at_knots(dense, cubics)  # from the camera then
    ends, end_rates = turns_at(np.array([-length, 0.0]), dense, cubics, rotations)
    rotation = ends[0].T.copy()
    angle = log(ends[0].copy())
    x, y, z = angle[0], angle[1], angle[2]
    squared = x * x + y * y + z * z
    _, c, d = coefficients(squared)
    by_parameters = np.empty((3, PARAMETERS))
    # A constant rate in the camera's axes of each moment, seen in those of then: the right
    # Jacobian of the exponential.
    by_parameters[0, 0] = -length * (1.0 - d * (y * y + z * z))
    by_parameters[1, 1] = -length * (1.0 - d * (x * x + z * z))
    by_parameters[2, 2] = -length * (1.0 - d * (x * x + y * y))
    by_parameters[0, 1] = -length * (c * z + d * x * y)
    by_parameters[1, 0] = -length * (-c * z + d * x * y)
    by_parameters[0, 2] = -length * (-c * y + d * x * z)
    by_parameters[2, 0] = -length * (c * y + d * x * z)
    by_parameters[1, 2] = -length * (c * x + d * y * z)
    by_parameters[2, 1] = -length * (-c * x + d * y * z)
    for k in range(3):
        started = 0.0
        for j in range(3):
            started += rotation[k, j] * end_rates[0, j]
        by_parameters[k, OFFSET] = started - end_rates[1, k]
    variance = noise * noise * length + SCALE_DEVIATION * SCALE_DEVIATION * squared
    return rotation, by_parameters, variance


def _spanning(
    samples: ImuSamples, at_ns: int, before: float, after: float, errors: GyroscopeErrors
) -> tuple[Array, Array] | None:
    """Times (k,) in s since a moment and rates (k,3) without the bias that span what is around."""
    here_ns = at_ns - round(1e9 * errors.time_offset)  # by the clock of the samples
    part = samples.around(here_ns - round(1e9 * before), here_ns + round(1e9 * after))
    if part is None:
        return None
    times = np.asarray(1e-9 * (samples.times_ns[part] - here_ns), np.float64)
    return times, samples.angular_velocity[part] - errors.bias
