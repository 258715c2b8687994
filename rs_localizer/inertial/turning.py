# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Turns of the camera by the gyroscope: within a frame, and from one to the next.

How they depend on the time offset is seen by shifting the samples to and fro by its standard
deviation (the unscented transform: Julier, Uhlmann, "Unscented filtering and nonlinear estimation",
2004). While the offset is hardly known, the derivative of a vibration would say nothing of what a
shift makes of it; what is no line within the deviation counts as noise.

Rates between the samples of a gyroscope.

A gyroscope filters what it shows below half its sample rate, so its samples tell the rates between
them; but a cubic spline through the samples loses 4 % of a vibration at 0.3 of the sample rate (3
deg/s of 0.1 deg at 120 Hz and 400 Hz). The best guess of a process whose spectrum is flat up to a
limit (a Gaussian process with a cardinal sine as covariance; Wiener, 1949) loses 0.15 %, with four
samples on each side. It is taken half way between the samples; for what lies between those, cubics
are good enough.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, IntArray, IntArray1
from rs_localizer.core.blocks import median, write
from rs_localizer.core.gyro_rotation import GyroRotation, turn_of
from rs_localizer.core.rate_spline import multiplied, rotations_at_knots, spline, turns_at
from rs_localizer.core.so3 import coefficients, log
from rs_localizer.inertial.gyroscope_noise import JITTER, SCALE_DEVIATION
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.native import entry, kernel

# End of the spectrum, as a part of the sample rate, and noise beside it (variance).
_BAND, _NOISE = 0.4, 1e-5
# More samples than this in an exposure are dense enough, and solving for them would take time.
_MOST = 64


@kernel
def densified(times: Array, rates: Array) -> tuple[Array, Array]:
    """Times (2 n - 1,) and rates (2 n - 1,3): those given, and one between each two of them.

    Args:
        times: (n,) increasing, s; they need not be regular.
        rates: (n,3) at these times.
    """
    count = len(times)
    if not 3 < count <= _MOST:
        return times, rates
    steps = np.empty(count - 1)
    for i in range(count - 1):
        steps[i] = times[i + 1] - times[i]
    width = 2.0 * np.pi * _BAND / median(steps)
    # The sine of a difference by those of both: n of them, not n^2.
    sines, cosines = np.sin(width * times), np.cos(width * times)
    factor = np.empty((count, count))
    # Nothing is supposed of the mean.
    mean = np.zeros(3)
    for i in range(count):
        for axis in range(3):
            mean[axis] += rates[i, axis] / count
    solved = rates - mean
    for i in range(count):  # Cholesky, and the first substitution beside it
        for j in range(i + 1):
            sine = sines[i] * cosines[j] - cosines[i] * sines[j]
            total = 1.0 + _NOISE if i == j else sine / (width * (times[i] - times[j]))
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = np.sqrt(max(total, _NOISE * _NOISE)) if i == j else total / factor[j, j]
        for axis in range(3):
            left = solved[i, axis]
            for k in range(i):
                left -= factor[i, k] * solved[k, axis]
            solved[i, axis] = left / factor[i, i]
    for i in range(count - 1, -1, -1):
        for axis in range(3):
            left = solved[i, axis]
            for k in range(i + 1, count):
                left -= factor[k, i] * solved[k, axis]
            solved[i, axis] = left / factor[i, i]
    dense, found = np.empty(2 * count - 1), np.zeros((2 * count - 1, 3))
    for i in range(count):
        dense[2 * i] = times[i]
        write(found[2 * i], rates[i])
        if i + 1 < count:
            between = 0.5 * (times[i] + times[i + 1])
            write(found[2 * i + 1], mean)
            dense[2 * i + 1] = between
            here, aside = np.sin(width * between), np.cos(width * between)
            for k in range(count):
                sine = here * cosines[k] - aside * sines[k]
                weight = sine / (width * (between - times[k]))
                for axis in range(3):
                    found[2 * i + 1, axis] += weight * solved[k, axis]
    return dense, found


PARAMETERS = 4
"""Of a gyroscope: its bias (3, rad/s), and the time offset of its stamps (s)."""
BIAS, OFFSET = slice(0, 3), 3

# The integral of white noise is a random walk. The least-squares parabola of one over an interval
# of length 1 has a slope and a curvature of these variances (by its Legendre coefficients).
_WALK_SLOPE, _WALK_CURVATURE = 6.0 / 5.0, 120.0 / 7.0
# Of the samples, s or readouts.
_LEAST_SHIFT = 1e-4
# A vibration of more than this (rad per readout) of whose phase nothing is known, because the
# offset is not known this well (s), says nothing of bias and offset: one that is in step with the
# frames is the same in all of them, as a bias is.
MOST_ROUGH, _NEAR = 2e-3, 5e-4
_WAVE_SLOPE = 60.0  # squared slope of a line through a wave, to its mean square; at most


_Turn = tuple[Array, Array, Array, Array, Array, Array, float]


@dataclass(frozen=True, slots=True, eq=False)
class GyroscopeErrors:
    """Estimates of a gyroscope's errors."""

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
    variances: Array  # (3,) rad^2, by noise and scale

    @property
    def numbers(self) -> tuple[Array, Array, Array]:
        """Numbers as kernels take them."""
        return self.rotation, self.by_parameters, self.variances


@dataclass(frozen=True, slots=True, eq=False)
class TurnWithin:
    """The turn during a frame, and how what it leaves depends on what is not known.

    That is the rate and its change (6), per readout, along the axes of the middle row.
    """

    known: GyroRotation
    by_parameters: Array  # (6,4)
    variances: Array  # (6,) by noise and scale

    @property
    def numbers(self) -> tuple[Array, Array]:
        """Numbers as kernels take them."""
        return self.by_parameters, self.variances


def turn_within(
    samples: ImuSamples, middle_ns: int, readout_time: float, errors: GyroscopeErrors
) -> TurnWithin | None:
    """Turn of the camera during a frame; None if the samples do not cover it.

    Args:
        middle_ns: exposure of the middle row.
        readout_time: s.
    """
    here_ns = _by_samples(middle_ns, errors)
    reach_ns = round(0.5e9 * readout_time)
    span = samples.around(here_ns - reach_ns, here_ns + reach_ns)
    if span is None:
        return None
    turn, error, by_parameters, variances, period = _within(
        samples.times_ns[span], samples.angular_velocity[span], here_ns, errors.bias, readout_time,
        errors.noise, errors.covariance,
    )  # fmt: skip
    rate_noise = errors.noise * readout_time / math.sqrt(period)
    delay = math.sqrt(errors.covariance[OFFSET, OFFSET] + JITTER**2) / readout_time
    rate_error = readout_time**2 * errors.covariance[BIAS, BIAS]
    known = GyroRotation(*turn, error, rate_noise, delay, rate_error)
    return TurnWithin(known, by_parameters, variances)


def turn_between(
    samples: ImuSamples, from_ns: int, to_ns: int, errors: GyroscopeErrors
) -> TurnBetween | None:
    """Turn of the camera from one moment to a later one; None if the samples do not cover it."""
    length = 1e-9 * (to_ns - from_ns)
    here_ns = _by_samples(to_ns, errors)
    span = samples.around(here_ns - (to_ns - from_ns), here_ns)
    if span is None:
        return None
    found = _between(
        samples.times_ns[span], samples.angular_velocity[span], here_ns, errors.bias, length,
        errors.noise, math.sqrt(errors.covariance[OFFSET, OFFSET]),
    )  # fmt: skip
    return TurnBetween(*found)


def _by_samples(at_ns: int, errors: GyroscopeErrors) -> int:
    """A moment by the clock of the samples."""
    return at_ns - round(1e9 * errors.time_offset)


@kernel
def _relative(times_ns: IntArray, rates: Array, here_ns: int, bias: Array) -> tuple[Array, Array]:
    """Times (k,) in s since a moment, and rates (k,3) without the bias."""
    count = len(times_ns)
    times, steady = np.empty(count), np.empty((count, 3))
    for i in range(count):
        times[i] = 1e-9 * (times_ns[i] - here_ns)
        for axis in range(3):
            steady[i, axis] = rates[i, axis] - bias[axis]
    return times, steady


@entry
def _within(
    times_ns: IntArray1, rates: Array2, here_ns: int, bias: Array1, readout_time: float,
    noise: float,
    of_parameters: Array2,
) -> tuple[_Turn, Array, Array, Array, float]:  # fmt: skip
    """The turn of a :class:`GyroRotation`, its error and so on; the samples' period (s)."""
    times, steady = _relative(times_ns, rates, here_ns, bias)
    period = (times[-1] - times[0]) / (len(times) - 1)
    dense, found = densified(times, steady)
    tau = dense / readout_time
    cubics, rotations, rate, change, parabola, rough = turn_of(tau, found * readout_time)
    deviation = np.sqrt(of_parameters[OFFSET, OFFSET])
    shift = _shift(deviation / readout_time, tau[0] + 0.5, tau[-1] - 0.5)
    wanted = np.array([-0.5, 0.0, 0.5])
    early = _halves(turns_at(wanted - shift, tau, cubics, rotations)[0])
    middle = _halves(turns_at(wanted, tau, cubics, rotations)[0])
    late = _halves(turns_at(wanted + shift, tau, cubics, rotations)[0])
    by_parameters, variances = np.zeros((6, PARAMETERS)), np.empty(6)
    turned, changed = 0.0, 0.0
    for k in range(3):
        by_parameters[k, k] = -readout_time
        turned += middle[k] * middle[k]
        changed += middle[3 + k] * middle[3 + k]
    walk, scale = noise * noise * readout_time, SCALE_DEVIATION * SCALE_DEVIATION
    for k in range(6):
        # Samples of later times: each row has the rate of a little earlier.
        by_parameters[k, OFFSET] = -0.5 * (late[k] - early[k]) / (shift * readout_time)
        variances[k] = (0.5 * (late[k] + early[k]) - middle[k]) ** 2
        if k < 3:
            variances[k] += _WALK_SLOPE * walk + scale * turned
        else:
            variances[k] += _WALK_CURVATURE * walk + scale * changed
    if rough * min(deviation / _NEAR, 1.0) > MOST_ROUGH:
        for k in range(6):
            variances[k] += rough * rough * (2.0 if k < 3 else 2.0 * _WAVE_SLOPE)
            uncertain = 0.0
            for column in range(PARAMETERS):
                own = by_parameters[k, column]
                uncertain += own * own * of_parameters[column, column]
            variances[k] += uncertain
        by_parameters[:] = 0.0
    error = by_parameters @ of_parameters @ by_parameters.T
    for k in range(6):
        error[k, k] += variances[k]
    turn = (tau, cubics, rotations, rate, change, parabola, rough)
    return turn, error, by_parameters, variances, period


@kernel
def _shift(deviation: float, before: float, after: float) -> float:
    """Shift as far as deviation and samples reach; never so little that rounding decides."""
    shift: float = max(min(deviation, -before, after), _LEAST_SHIFT)
    return shift


@kernel
def _halves(rotations: Array) -> Array:
    """Mean rate and its change (6,) of a turn (3,3,3) over an interval of length 1."""
    first = log(multiplied(rotations[0], rotations[1].T.copy()))
    second = log(multiplied(rotations[1], rotations[2].T.copy()))
    found = np.empty(6)
    for k in range(3):
        found[k] = first[k] + second[k]
        found[3 + k] = 4.0 * (second[k] - first[k])
    return found


@entry
def _between(
    times_ns: IntArray1, rates: Array2, here_ns: int, bias: Array1, length: float, noise: float,
    deviation: float,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """The fields of a :class:`TurnBetween`; it ends here."""
    dense, found = densified(*_relative(times_ns, rates, here_ns, bias))
    cubics = spline(dense, found)
    rotations = rotations_at_knots(dense, cubics)  # from the camera then
    shift = _shift(deviation, dense[0] + length, dense[-1])
    wanted = np.array([-length, 0.0, -length - shift, -shift, shift - length, shift])
    turned, _ = turns_at(wanted, dense, cubics, rotations)
    rotation = multiplied(turned[1], turned[0].T.copy())
    angle = log(rotation.T.copy())
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
    # By how much more the camera turns if the samples come later, or earlier.
    back = rotation.T.copy()
    late = log(multiplied(multiplied(turned[3], turned[2].T.copy()), back))
    early = log(multiplied(multiplied(turned[5], turned[4].T.copy()), back))
    variances = np.empty(3)
    for k in range(3):
        by_parameters[k, OFFSET] = -0.5 * (late[k] - early[k]) / shift
        variances[k] = (0.5 * (late[k] + early[k])) ** 2
        variances[k] += noise * noise * length + SCALE_DEVIATION * SCALE_DEVIATION * squared
    return rotation, by_parameters, variances
