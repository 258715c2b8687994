"""Turns of the camera by the gyroscope: within a frame, and from one to the next."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.known_turn import KnownTurn, multiplied, rotations_at_knots, spline, turns_at
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
    covariance: Array  # (3,3) of noise and scale, rad^2, likewise


def turn_within(
    samples: ImuSamples, middle_ns: int, readout_time: float, errors: GyroscopeErrors
) -> KnownTurn | None:
    """How the camera turns during a frame; None if the samples do not cover it.

    Args:
        middle_ns: exposure of the middle row.
        readout_time: s.
    """
    times, rates = _spanning(samples, middle_ns, 0.5 * readout_time, 0.5 * readout_time, errors)
    if times is None or rates is None:
        return None
    turn = KnownTurn.of(times / readout_time, rates * readout_time)
    period = float(np.median(np.diff(times)))
    noise = errors.noise * readout_time / np.sqrt(period)
    jacobian = sensitivity(turn, readout_time)
    error = unforeseen(turn, readout_time, errors.noise) + jacobian @ errors.covariance @ jacobian.T
    return replace(turn, error=error, rate_noise=float(noise))


def turn_between(
    samples: ImuSamples, from_ns: int, to_ns: int, errors: GyroscopeErrors
) -> TurnBetween | None:
    """How the camera turns from one moment to a later one; None if the samples do not cover it."""
    length = 1e-9 * (to_ns - from_ns)
    times, rates = _spanning(samples, to_ns, length, 0.0, errors)
    if times is None or rates is None:
        return None
    cubics = spline(times, rates)
    rotations = rotations_at_knots(times, cubics)  # from the camera then
    ends, end_rates = turns_at(np.array([-length, 0.0]), times, cubics, rotations)
    then_from_now = ends[0].T.copy()
    by_parameters = np.zeros((3, PARAMETERS))
    angle = so3.log(then_from_now.T.copy())
    # A constant rate in the camera's axes of each moment, seen in those of then.
    by_parameters[:, BIAS] = -length * so3.right_jacobian(angle)
    by_parameters[:, OFFSET] = then_from_now @ end_rates[0] - end_rates[1]
    variance = errors.noise**2 * length + SCALE_DEVIATION**2 * float(angle @ angle)
    return TurnBetween(then_from_now, by_parameters, variance * np.eye(3))


def sensitivity(turn: KnownTurn, readout_time: float) -> Array:
    """Derivatives (6,4) of the rate that a known turn leaves, and of its change, per readout.

    By the gyroscope's parameters, at least squares over the readout, along the axes at tau = 0.
    """
    _, rates = turn.at_rows(np.array([-0.5, 0.0, 0.5]))
    jacobian = np.zeros((6, PARAMETERS))
    jacobian[:3, BIAS] = -readout_time * np.eye(3)
    # Samples of later times: each row has the rate of a little earlier.
    jacobian[:3, OFFSET] = (rates[0] - rates[2]) / readout_time
    jacobian[3:, OFFSET] = -4.0 * (rates[0] - 2.0 * rates[1] + rates[2]) / readout_time
    return jacobian


def unforeseen(turn: KnownTurn, readout_time: float, noise: float) -> Array:
    """Covariance (6,6) of the same by noise (rad/s/sqrt(Hz)) and scale of the gyroscope."""
    ends, rates = turn.at_rows(np.array([-0.5, 0.5]))
    whole = so3.log(multiplied(ends[1], ends[0].T.copy()))
    slope = rates[1] - rates[0]
    walk, scale = noise**2 * readout_time, SCALE_DEVIATION**2
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = (_WALK_SLOPE * walk + scale * (whole @ whole)) * np.eye(3)
    covariance[3:, 3:] = (_WALK_CURVATURE * walk + scale * (slope @ slope)) * np.eye(3)
    return covariance


def _spanning(
    samples: ImuSamples, at_ns: int, before: float, after: float, errors: GyroscopeErrors
) -> tuple[Array, Array] | tuple[None, None]:
    """Times (k,) in s since a moment and rates (k,3) without the bias that span what is around."""
    offset_ns = round(1e9 * errors.time_offset)
    here_ns = at_ns - offset_ns  # by the clock of the samples
    part = samples.around(here_ns - round(1e9 * before), here_ns + round(1e9 * after))
    if part is None:
        return None, None
    times = np.asarray(1e-9 * (part.times_ns - here_ns), np.float64)
    return times, part.angular_velocity - errors.bias
