# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The camera's rotation by the readings of its gyroscope, within a frame and since the last one.

The gyroscope is off by ten numbers, of which the track knows a mean and a covariance:

    reading(t) = (I + S) M omega(t + d) + b + noise

a bias ``b``, a delay ``d`` of its stamps, scales ``S`` of its axes and a turn ``M`` of its mount.
A vibration whose phase nobody knows, because the delay is known no better than a part of its
period, is no rotation that is known: rates are averaged over where the delay may lie.

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

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, Array1, Array2, BoolArray
from rs_localizer.core.blocks import median, write
from rs_localizer.core.gyro_rotation import GyroRotation, turn_of
from rs_localizer.core.rate_spline import rotations_at_knots, spline, turns_at
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.native import entry

PARAMETERS = 10
"""Number of a gyroscope's errors; their places are BIAS, DELAY, SCALE and MOUNT."""
BIAS, DELAY, SCALE, MOUNT = slice(0, 3), slice(3, 4), slice(4, 7), slice(7, 10)
BETWEEN, RATE, CHANGE = slice(0, 3), slice(3, 6), slice(6, 9)
"""Places of the turn since the last frame, the rate in this frame, and its change."""

# Deviation (s) of stamps of single frames and samples beside a constant delay, at best.
_JITTER = 4e-5
# Error of a rotation beside scales and mount: axes that are not square, by data sheets.
_SKEW = 0.003
# The integral of white noise is a random walk. The least-squares parabola of one over an interval
# of length 1 has a slope and a curvature of these variances (by its Legendre coefficients).
_WALK_SLOPE, _WALK_CURVATURE = 6.0 / 5.0, 120.0 / 7.0
# Squared mean and slope of a line through a vibration, to its mean square; at most.
_WAVE_MEAN, _WAVE_SLOPE = 2.0, 120.0
# Share of the samples' period: shifts by less leave all that samples show.
_SHORT = 0.3
# s of a shift that rounding does not decide; and of squared rates.
_LEAST_SHIFT, _TINY = 1e-6, 1e-30

# End of the spectrum, as a part of the sample rate, and noise beside it (variance).
_BAND, _NOISE = 0.4, 1e-5
# With more samples than this in an exposure they are dense enough, and solving for them would take
# time.
_MOST = 64


def _densified(times: Array, rates: Array) -> tuple[Array, Array]:
    """Add samples between the last ones, which are the frame's."""
    late = max(len(times) - _MOST, 0)
    dense, found = densified(times[late:].copy(), rates[late:].copy())
    return np.concatenate([times[:late], dense]), np.concatenate([rates[:late], found])


@entry
def densified(times: Array1, rates: Array2) -> tuple[Array, Array]:
    """Return times (2 n - 1,) and rates (2 n - 1,3): the given ones, and one between each two.

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
    # The mean has no prior.
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


@dataclass(frozen=True, slots=True, eq=False)
class GyroscopeErrors:
    """Errors of a gyroscope, as far as they are known."""

    mean: Array  # (10,) rad/s, s, shares, rad
    covariance: Array  # (10,10)
    noise: float  # rad/s/sqrt(Hz)

    @property
    def bias(self) -> Array:
        """(3,) rad/s, to be taken from its rates."""
        return self.mean[BIAS]

    @property
    def time_offset(self) -> float:
        """Seconds to be added to its times."""
        return float(self.mean[DELAY.start])

    def corrected(self, rates: Array) -> Array:
        """Return the rates (n,3) of the camera by those that were read."""
        shown = (rates - self.bias) / (1.0 + self.mean[SCALE])
        turned: Array = shown @ so3.exp(np.ascontiguousarray(self.mean[MOUNT])).T
        return np.ascontiguousarray(turned)

    def derivative(self, rate: Array) -> Array:
        """Return the derivative (3,10) of a corrected rate (3,) by all but the delay."""
        mount, scale = so3.exp(np.ascontiguousarray(self.mean[MOUNT])), 1.0 + self.mean[SCALE]
        by_errors = np.zeros((3, PARAMETERS))
        by_errors[:, BIAS] = -mount / scale
        by_errors[:, SCALE] = -mount * (mount.T @ rate) / scale
        by_errors[:, MOUNT] = -so3.hat(rate)
        return by_errors


@dataclass(frozen=True, slots=True, eq=False)
class Rotated:
    """The rotation by a gyroscope, and how it depends on what is not known of that."""

    known: GyroRotation  # within the frame
    between: Array | None  # (3,3) camera_then_from_camera_now
    # (9,10) of the turn since the last frame, in the axes of then, and of rate and change that the
    # known rotation leaves, per readout
    by_errors: Array
    variances: Array  # (9,) of what else is not known
    swing: Array  # (3,) rad^2, variances of the turn by vibration whose phase is not known


def rotated(
    samples: ImuSamples, middle_ns: int, readout_time: float, errors: GyroscopeErrors,
    since_ns: int | None = None,
) -> Rotated | None:  # fmt: skip
    """Return the rotation in a frame and since a moment before; None: samples do not cover it.

    Args:
        middle_ns: exposure of the middle row.
        readout_time: s.
        since_ns: of the middle row of the last frame.
    """
    here_ns, half = middle_ns - round(1e9 * errors.time_offset), 0.5 * readout_time
    length = 0.0 if since_ns is None else 1e-9 * (middle_ns - since_ns)
    before = max(length, half)
    span = samples.around(here_ns - round(1e9 * before), here_ns + round(1e9 * half))
    if span is None:
        return None
    deviation = math.hypot(math.sqrt(errors.covariance[DELAY, DELAY].item()), _JITTER)
    reach_ns = round(2e9 * deviation)
    first = int(samples.times_ns.searchsorted(samples.times_ns[span.start] - reach_ns))
    last = int(samples.times_ns.searchsorted(samples.times_ns[span][-1] + reach_ns, "right"))
    times = np.asarray(1e-9 * (samples.times_ns[first:last] - here_ns), np.float64)
    rates = errors.corrected(samples.angular_velocity[first:last])
    period = float(times[-1] - times[0]) / (len(times) - 1)
    # Samples may not reach as far as the delay may.
    shift = max(min(deviation, times[-1] - half, -before - times[0]), _LEAST_SHIFT)
    dense, found = _densified(times, rates)
    near = (dense >= times[span.start - first]) & (dense <= times[min(span.stop, last) - 1 - first])
    rough, swing = np.zeros(3), np.zeros(3)
    if shift > _SHORT * period:
        smooth, rough, swing = _averaged(dense, found, shift, near)
        found, rough = smooth, rough * readout_time**2
    dense, found = dense[near], found[near]
    by_errors, variances = np.zeros((9, PARAMETERS)), np.zeros(9)
    # Turn since the last frame, rate and change by samples that are so much later.
    shown = np.array([_shown(dense, found, length, half, late) for late in (-shift, 0.0, shift)])
    by_errors[:, DELAY] = -0.5 / shift * (shown[2] - shown[0])[:, None]
    variances += (0.5 * (shown[2] + shown[0]) - shown[1]) ** 2
    variances += (_JITTER * by_errors[:, DELAY.start]) ** 2
    between = None
    if length > 0.0:
        cubics = spline(dense, found)
        turns, _ = turns_at(
            np.array([-length, 0.0]), dense, cubics, rotations_at_knots(dense, cubics)
        )
        between = np.ascontiguousarray(turns[1] @ turns[0].T)
        angle = so3.log(np.ascontiguousarray(between.T))
        # A constant rate in the camera's axes of each moment, seen in those of then.
        by_rate = length * so3.right_jacobian(angle)
        by_errors[BETWEEN] += by_rate @ errors.derivative(angle / length)
    unit = readout_time
    by_errors[RATE] += unit * errors.derivative(shown[1][RATE] / unit)
    by_errors[CHANGE] += unit * errors.derivative(shown[1][CHANGE] / unit)
    by_errors[CHANGE, BIAS] = 0.0
    variances += _SKEW**2 * np.repeat(np.square(shown[1]).reshape(3, 3).sum(axis=1), 3)
    walk = errors.noise**2
    variances += walk * np.repeat(
        [length, _WALK_SLOPE * readout_time, _WALK_CURVATURE * readout_time], 3
    )
    variances += np.concatenate([_WAVE_MEAN * swing, _WAVE_MEAN * rough, _WAVE_SLOPE * rough])
    within = slice(BETWEEN.stop, None)
    error = by_errors[within] @ errors.covariance @ by_errors[within].T
    error[np.diag_indices(6)] += variances[within]
    static = by_errors[RATE].copy()
    static[:, DELAY] = 0.0
    tau = dense / readout_time
    known = GyroRotation(
        tau, *turn_of(tau, found * readout_time), error,
        errors.noise * readout_time / math.sqrt(period), deviation / readout_time,
        static @ errors.covariance @ static.T + np.diag(rough),
    )  # fmt: skip
    return Rotated(known, between, by_errors, variances, swing)


def _averaged(
    times: Array, rates: Array, deviation: float, near: BoolArray
) -> tuple[Array, Array, Array]:
    """Average rates (n,3) over a normal shift of their times (n,).

    Returns:
        averages; of those that are near, variances (3,) about the average, but for what goes with
        the shift, and of the turns to and fro that these make.
    """
    weights = np.gradient(times) * np.exp(-0.5 * ((times[:, None] - times) / deviation) ** 2)
    weights /= weights.sum(axis=1)[:, None]
    averaged = weights @ rates
    # The part that is linear in the shift is left out.
    along = deviation * np.gradient(averaged, times, axis=0)
    spread = (weights @ rates**2 - averaged**2 - along**2)[near]
    rough = np.maximum(spread.mean(axis=0), 0.0)
    left = (rates - averaged)[near]
    turned = np.cumsum(left * np.gradient(times[near])[:, None], axis=0)
    return averaged, rough, rough * turned.var(axis=0) / np.maximum((left**2).mean(axis=0), _TINY)


def _shown(times: Array, rates: Array, length: float, half: float, late: float) -> Array:
    """Return what rates say (9,) if they come so much later.

    That is the turn over a length until time 0, and mean rate and its change over a readout, of so
    much on both sides of it, per readout. Axes are those of each moment: how they turn meanwhile
    makes no difference to a small shift.
    """
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(times)[:, None]
    angles = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    wanted = np.array([-length, -half, 0.0, half]) + late
    at = np.clip(np.searchsorted(times, wanted) - 1, 0, len(times) - 2)
    since, step = (wanted - times[at])[:, None], (times[at + 1] - times[at])[:, None]
    bend = 0.5 * since**2 / step * (rates[at + 1] - rates[at])
    past, first, middle, last = angles[at] + since * rates[at] + bend
    return np.concatenate([middle - past, last - first, 4.0 * (last - 2.0 * middle + first)])
