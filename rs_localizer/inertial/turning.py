# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The camera's rotation by the readings of its gyroscope, within a frame and since the last one.

The gyroscope is off by ten numbers, of which the track knows a mean and a covariance:

    reading(t) = (I + S) M omega(t + d) + b + noise

a bias ``b``, a delay ``d`` of its stamps, scales ``S`` of its axes and a turn ``M`` of its mount.
The rotation is a mean and a covariance of numbers that are linear in the rates. Delays are
sampled, because a vibration is not linear in them: its mean square is then in the covariance.

The rates between samples, and their covariance, are those of a Gaussian process (Wiener, 1949). Its
spectrum and the noise are read from some tenths of a second of samples. They are a sum of waves, a
constant and a slope, so that a delay shifts the waves' phases.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.rotation_prior import NODES, after, parts_of
from rs_localizer.core.shake import COMBINATIONS, MIDDLE_RATES, RESOLVED, shake_functions
from rs_localizer.inertial.samples import MARGIN, ImuSamples

PARAMETERS = 10
"""Number of a gyroscope's errors; their places are BIAS, DELAY, SCALE and MOUNT."""
BIAS, DELAY, SCALE, MOUNT = slice(0, 3), slice(3, 4), slice(4, 7), slice(7, 10)
BETWEEN, WITHIN = slice(0, 3), slice(3, 63)
"""Places of the turn since the last frame, and of what rotates within this frame: rate, change, and
the coefficients of the in-frame turn (:mod:`rs_localizer.core.rotation_prior`)."""

# Deviation (s) of stamps of single frames and samples beside a constant delay, at best.
_JITTER = 4e-5
# Error of a rotation beside scales and mount: axes that are not square, by data sheets.
_SKEW = 0.003
# Deviations of a delay to which it is looked at, and to how many delays at most.
_REACH, _MOST_DELAYS = 2.5, 81
# Share of the samples' period: shifts by less leave all that samples show.
_SHORT = 0.3
# s of a shift that rounding does not decide.
_LEAST_SHIFT = 1e-6
# (rad per readout)^2 of the noise of rates, and size of an in-frame turn over an ordinary one: it
# is as small as it can be beside a constant change of the rate.
_USUAL_NOISE, _SIZE = 1e-13, 0.003
# Row times at which rates are compared.
_TAU = np.linspace(-0.5, 0.5, 41)

# s of readings that are alike: of a spectrum's pieces, and so many readings at least and at most.
_ALIKE, _FEWEST, _MOST = 0.16, 16, 128
# Into so many parts of a spectrum its noise is looked for; the first cycles of a piece show motion.
_BANDS, _SLOW = 8, 6
# Frequencies of a band that tell of noise independently (Harris, 1978, of this taper), per band's
# length; and deviations that the least of some eight means lies below the mean.
_INDEPENDENT, _BELOW = 1.0 / 3.0, 1.5
# Variance of a constant rate, over the mean square of readings; and of its slope, over that of the
# last pieces, which may be few.
_VAGUE, _STEEPER = 100.0, 4.0
# Noise over the readings' mean square, or (rad/s)^2, that rounding does not decide.
_LEAST = 1e-9


Waves = np.ndarray[Any, np.dtype[np.complex128]]


class Spectrum(NamedTuple):
    """The rates of a camera by frequency, and the noise of readings, as they tell both."""

    frequencies: Array  # (f,) rad/s, evenly from 0
    variances: Array  # (f,) (rad/s)^2 of the camera's rates about an axis
    noise: float  # (rad/s)^2 of a reading about an axis
    constant: float  # (rad/s)^2 of a constant rate about an axis
    slope: float  # (rad/s^2)^2 of its change


def spectrum_of(times_ns: IntArray, rates: Array, noise: float) -> Spectrum:
    """Return the spectrum of a camera's rates by readings of some tenths of a second.

    Noise is what all frequencies have: the least that a part of the spectrum shows (Welch, "The use
    of fast Fourier transform for the estimation of power spectra", 1967).

    Args:
        times_ns: (n,).
        rates: (n,3) rad/s.
        noise: rad/s/sqrt(Hz), the least.
    """
    period = 1e-9 * float(times_ns[-1] - times_ns[0]) / (len(times_ns) - 1)
    length = min(max(round(_ALIKE / period), _FEWEST), _MOST, len(rates))
    starts = np.arange(len(rates) - length, -1, -max(length // 2, 1))
    pieces = rates.T[:, starts[:, None] + np.arange(length)]
    line, taper = _piece(length)
    lines = pieces @ line
    shown = np.fft.rfft((pieces - lines @ line.T) * taper, 2 * length).view(float)
    power = np.einsum("apf,apf->f", shown, shown).reshape(-1, 2).sum(axis=1)
    power /= 3.0 * len(starts) * (taper @ taper)  # of white noise: its variance
    # Deviations over means: of a frequency, and of a band.
    doubt = 1.0 / math.sqrt(3 * len(starts))
    band, square = max(length // _BANDS, 1), float(np.mean(rates**2))
    quick = power[min(_SLOW, length // 2) :]
    least = float(np.convolve(quick, np.full(band, 1.0 / band), "valid").min())
    least *= 1.0 + _BELOW * doubt / math.sqrt(max(_INDEPENDENT * band, 1.0))
    variance = max(noise**2 / period, least, _LEAST * (1.0 + square))
    beside = power - variance
    own = 0.5 * (beside + np.hypot(beside, doubt * variance)) / length
    own[[0, -1]] *= 0.5
    cycles = np.arange(length + 1) / (2 * length * period)
    slope = max(float(np.mean(lines[..., 0] ** 2)) - variance, doubt * variance)
    slope *= _STEEPER * 12.0 / (length**3 * period**2)
    constant = _VAGUE * (square + variance)
    return Spectrum(2.0 * np.pi * cycles, own, variance, constant, slope)


@cache
def _piece(length: int) -> tuple[Array, Array]:
    """Return a slope and a constant (n,2), orthonormal, and a taper (n,) of so many readings."""
    line = np.linalg.qr(np.vander(np.arange(length) - 0.5 * length, 2))[0]
    return line, np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2


def waves_at(times: Array, spectrum: Spectrum) -> Waves:
    """Return the waves of a spectrum, a constant and a slope at times (n,): (n,f+1)."""
    waves = np.ones((len(spectrum.frequencies) + 1, len(times)), np.complex128)
    turning, waves[-1] = np.exp(1j * spectrum.frequencies[1] * times), times
    for k in range(len(waves) - 2):  # twice as fast as a cumulative product
        np.multiply(waves[k - 1] if k else 1.0, turning, out=waves[k])
    return waves.T


def smoothed(own: Waves, rates: Array, rows: Waves, spectrum: Spectrum) -> tuple[Waves, Array]:
    """Return factors (f+1,3) of the waves by readings (n,3), and a covariance (r,r) of an axis.

    The real parts of products of waves and factors are rates.

    Args:
        own: (n,f+1) the waves at the readings.
        rows: (r,f+1) those of the covariance.
    """
    _, variances, noise, constant, slope = spectrum
    sizes = np.sqrt(np.concatenate([variances[1:], [constant + variances[0], slope]]))
    shown, last = (np.multiply(each, sizes, order="C").view(float) for each in (own, rows))
    known, crossed = shown @ shown.T, shown @ last.T
    known.flat[:: len(own) + 1] += noise
    told = np.linalg.solve(known, np.concatenate([rates, crossed], axis=1))
    left = last @ last.T - crossed.T @ told[:, 3:]
    parts = (shown.T @ told[:, :3]).reshape(-1, 2, 3)
    return sizes[:, None] * (parts[:, 0] - 1j * parts[:, 1]), left


def turned(path: Array, rates: Array) -> Array:
    """Return rotations (n,3,3) camera_then_from_camera_first at moments (n,) of a path, s.

    Args:
        rates: (2 n - 1,3) rad/s, at these and half way between.
    """
    ends, middles = rates[: len(path)], rates[len(path) :]
    # By Simpson's rule; axes that change within a step turn the camera by some 1e-6 rad.
    steps = (ends[:-1] + 4.0 * middles + ends[1:]) * ((path[1:] - path[:-1])[:, None] / 6.0)
    rotations: Array = after(steps)
    return rotations


def _parts_by_rates() -> Array:
    """Return the derivatives (20,n) of a rate, its change and an in-frame turn by rates (n,)."""
    rates = shake_functions(_TAU)[1] + MIDDLE_RATES
    shown = np.column_stack([np.ones(len(_TAU)), _TAU, rates @ COMBINATIONS])
    weights = np.gradient(_TAU)
    known = (shown.T * weights) @ shown
    prior = np.diag(np.repeat([1.0, _SIZE**-2], [2, RESOLVED]))
    return np.asarray(np.linalg.solve(known + _USUAL_NOISE * prior, shown.T * weights), np.float64)


_PARTS = _parts_by_rates()
_OF_CONSTANT = _PARTS.sum(axis=1)[:, None, None]  # of a constant rate


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

    def derivatives(self, rates: Array) -> Array:
        """Return the derivatives (n,3,10) of corrected rates (n,3) by all but the delay."""
        mount, scale = so3.exp(np.ascontiguousarray(self.mean[MOUNT])), 1.0 + self.mean[SCALE]
        rates = np.atleast_2d(rates)
        by_errors = np.zeros((len(rates), 3, PARAMETERS))
        by_errors[..., BIAS] = -mount / scale
        by_errors[..., SCALE] = -mount * (rates @ mount)[:, None] / scale
        by_errors[..., MOUNT] = -so3.hat(rates)
        return by_errors


class Read(NamedTuple):
    """The rotation by a gyroscope's readings, and how it depends on what is not known of that."""

    rate: Array  # (3,) in the frame, see RotationPrior
    change: Array  # (3,)
    shake: Array  # (28,3)
    between: Array | None  # (3,3) camera_then_from_camera_now
    by_errors: Array  # (63,10) of BETWEEN and WITHIN
    rest: Array  # (63,63) covariance of what else is not known


def read(
    samples: ImuSamples, middle_ns: int, readout_time: float, errors: GyroscopeErrors,
    since_ns: int | None = None,
) -> Read | None:  # fmt: skip
    """Return the rotation in a frame and since a moment before; None: samples do not cover it.

    Args:
        middle_ns: exposure of the middle row.
        readout_time: s.
        since_ns: of the middle row of the last frame, before or after.
    """
    here_ns, half = middle_ns - round(1e9 * errors.time_offset), 0.5 * readout_time
    length = 0.0 if since_ns is None else 1e-9 * (middle_ns - since_ns)
    first_ns, last_ns = (round(1e9 * end) for end in (-max(length, half), max(-length, half)))
    span = samples.around(here_ns + first_ns, here_ns + last_ns)
    if span is None:
        return None
    deviation = math.hypot(math.sqrt(errors.covariance[DELAY, DELAY].item()), _LEAST_SHIFT)
    reach_ns = round(_REACH * 1e9 * deviation)
    first = int(samples.times_ns.searchsorted(samples.times_ns[span.start] - reach_ns))
    last = int(samples.times_ns.searchsorted(samples.times_ns[span][-1] + reach_ns, "right"))
    times = np.asarray(1e-9 * (samples.times_ns[first:last] - here_ns), np.float64)
    period = float(times[-1] - times[0]) / (len(times) - 1)
    found = errors.corrected(samples.angular_velocity[first:last])
    # Up to the first one after the rows: how many others have come differs from run to run.
    come = span.stop - MARGIN + 1
    spectrum = spectrum_of(samples.times_ns[:come], samples.angular_velocity[:come], errors.noise)
    aside = 1e-9 * reach_ns + MARGIN * period
    # Waves of the spectrum repeat after two of its pieces: of a frame long ago readings are taken
    # as they are.
    for back, ahead in ((max(length, half), max(-length, half)), (half, half)):
        begin = int(times.searchsorted(-back - aside))
        end = int(times.searchsorted(ahead + aside))
        if end - begin < len(spectrum.frequencies):
            break
    near = slice(max(min(begin, end - len(spectrum.frequencies)), 0), end)
    delays, weights = _delays(deviation, period)
    # From the last frame to the first row, and on to the last one.
    nodes, count = readout_time * NODES, math.ceil(abs(length) / period)
    way = np.arange(count) * ((nodes[0] + length) / max(count, 1)) - length
    path = np.concatenate([way, nodes])
    moments = np.concatenate([path, 0.5 * (path[1:] + path[:-1]), [0.0, -length]])
    grid, first = readout_time * _TAU, len(delays) + len(times[near])
    shown = waves_at(np.concatenate([delays, times[near], grid, moments]), spectrum)
    along = shown[first + len(grid) :]
    rows = _PARTS @ shown[first : first + len(grid)]
    told, spread = smoothed(shown[len(delays) : first], found[near], rows, spectrum)
    # All that follows is by readings that are so much later.
    later = shown[: len(delays), :, None] * told
    later[:, -2] += later[:, -1]
    later[:, -1] = told[-1]
    late = readout_time * (rows @ later).real.reshape(len(delays), -1)
    ends = (along[-2:] @ later).real
    usual = (along[:-2] @ (weights @ later.reshape(len(delays), -1)).reshape(-1, 3)).real
    far = (moments < times[near][0]) & (near.start > 0)
    far |= (moments > times[near][-1]) & (end < len(times))
    if far.any():
        usual[far[:-2]] = _at(moments[:-2][far[:-2]], times, found)
        ends[:, far[-2:]] = _at(moments[-2:][far[-2:]] + delays[:, None], times, found)
    slopes = ends[:, 0] - ends[:, 1]
    # From the last frame to this one, beside a constant.
    steps = 0.5 * (slopes[1:] + slopes[:-1]) * (delays[1:] - delays[:-1])[:, None]
    every = np.concatenate([np.zeros((len(delays), 3)), late], axis=1)
    every[1:, BETWEEN] = np.cumsum(steps, axis=0)
    mean = weights @ every
    off, by_errors = every - mean, np.zeros((every.shape[1], PARAMETERS))
    by_errors[:, DELAY] = -((weights * delays) @ off)[:, None] / (weights @ delays**2)
    off += np.outer(delays, by_errors[:, DELAY.start])
    rest = (off.T * weights) @ off
    within = errors.derivatives(mean[WITHIN].reshape(-1, 3))
    within[..., BIAS] *= readout_time * _OF_CONSTANT
    by_errors[WITHIN] += within.reshape(-1, PARAMETERS)
    spread *= readout_time**2
    for axis in range(3):
        rest[WITHIN, WITHIN][axis::3, axis::3] += spread
    turns = turned(path, usual)
    turns = turns @ turns[len(path) - 1 - len(NODES) // 2].T
    if length != 0.0:
        angle = so3.log(np.ascontiguousarray(turns[0]))
        # A constant rate in the camera's axes of each moment, seen in those of then.
        by_rate = length * so3.right_jacobian(angle)
        by_errors[BETWEEN] += by_rate @ errors.derivatives(angle / length)[0]
        mean[BETWEEN] = angle
        rest[BETWEEN, BETWEEN] += spectrum.noise * period * abs(length) * np.eye(3)
    squares = np.square(mean).reshape(-1, 3).sum(axis=1)
    rest.flat[:: len(rest) + 1] += _SKEW**2 * np.repeat(squares, 3)
    rest += _JITTER**2 * np.outer(by_errors[:, DELAY.start], by_errors[:, DELAY.start])
    return Read(*parts_of(turns[-len(NODES) :]), turns[0].T if length else None, by_errors, rest)


def _delays(deviation: float, period: float) -> tuple[Array, Array]:
    """Return delays (d,) and weights of a normal deviate: three, if readings change as little."""
    if deviation <= _SHORT * period:
        return deviation * math.sqrt(3.0) * np.array([-1.0, 0.0, 1.0]), np.array([1, 4, 1]) / 6.0
    count = min(math.ceil(2.0 * _REACH * deviation / period), _MOST_DELAYS // 2)
    delays = _REACH * deviation * np.linspace(-1.0, 1.0, 2 * count + 1)
    weights = np.exp(-0.5 * (delays / deviation) ** 2)
    return delays, weights / weights.sum()


def _at(wanted: Array, times: Array, values: Array) -> Array:
    """Return values (...,3) between those (n,3) at times (n,); beyond them the last one."""
    found = [np.interp(wanted, times, values[:, axis]) for axis in range(3)]
    return np.stack(found, axis=-1)
