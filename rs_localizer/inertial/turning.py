# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The camera's rotation by the readings of its gyroscope, within a frame and since the last one.

The gyroscope is off by ten numbers, of which the track knows a mean and a covariance:

    reading(t) = (I + S) M omega(t + d) + b + noise

a bias ``b``, a delay ``d`` of its stamps, scales ``S`` of its axes and a turn ``M`` of its mount.
The rotation is a mean and a covariance of numbers that are linear in the rates. Delays are
sampled, because a vibration is not linear in them: its mean square is then in the covariance.

The rates between samples, and their covariance, are those of a Gaussian process (Wiener, 1949). Its
spectrum and the noise are read from some tenths of a second of samples. Rates are taken at the
samples and half way between them. There a cubic spline through the samples would lose 4 % of a
vibration at 0.3 of the sample rate; for what lies between those, cubics are good enough.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.rate_spline import rotations_at_knots, spline, turns_at
from rs_localizer.core.rotation_prior import NODES, parts_of
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
    pieces = rates[starts[:, None] + np.arange(length)]
    line, taper = _piece(length)
    lines = line.T @ pieces
    pieces = (pieces - line @ lines) * taper[:, None]
    shown = np.abs(np.fft.rfft(pieces, 2 * length, axis=1)) ** 2
    power = shown.mean(axis=(0, 2)) / (taper @ taper)  # of white noise: its variance
    # Deviations over means: of a frequency, and of a band.
    doubt = 1.0 / math.sqrt(3 * len(pieces))
    band, square = max(length // _BANDS, 1), float(np.mean(rates**2))
    quick = power[min(_SLOW, length // 2) :]
    least = float(np.convolve(quick, np.full(band, 1.0 / band), "valid").min())
    least *= 1.0 + _BELOW * doubt / math.sqrt(max(_INDEPENDENT * band, 1.0))
    variance = max(noise**2 / period, least, _LEAST * (1.0 + square))
    beside = power - variance
    own = 0.5 * (beside + np.hypot(beside, doubt * variance)) / length
    own[[0, -1]] *= 0.5
    cycles = np.arange(length + 1) / (2 * length * period)
    slope = max(float(np.mean(lines[:, 0] ** 2)) - variance, doubt * variance)
    slope *= _STEEPER * 12.0 / (length**3 * period**2)
    constant = _VAGUE * (square + variance)
    return Spectrum(2.0 * np.pi * cycles, own, variance, constant, slope)


@cache
def _piece(length: int) -> tuple[Array, Array]:
    """Return a slope and a constant (n,2), orthonormal, and a taper (n,) of so many readings."""
    line = np.linalg.qr(np.vander(np.arange(length) - 0.5 * length, 2))[0]
    return line, np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2


def smoothed(
    times: Array, rates: Array, wanted: Array, rows: Array, spectrum: Spectrum
) -> tuple[Array, Array]:
    """Return the rates (w,3) at wanted times by readings (n,3), and a covariance (r,r) of an axis.

    Args:
        times: (n,) of the readings, s.
        wanted: (w,) s.
        rows: (r,) s, of the covariance.
    """
    every = np.concatenate([times, wanted, rows])
    turning = np.exp(1j * spectrum.frequencies[1] * every)[:, None]
    waves = np.cumprod(np.repeat(turning, len(spectrum.frequencies) - 1, axis=1), axis=1)
    waves *= np.sqrt(spectrum.variances[1:])
    ones = np.full(len(every), math.sqrt(spectrum.constant + spectrum.variances[0]))
    shown = np.column_stack([waves.real, waves.imag, ones, math.sqrt(spectrum.slope) * every])
    own, other, last = np.split(shown, [len(times), len(times) + len(wanted)])
    known = own @ own.T + spectrum.noise * np.eye(len(times))
    told = np.linalg.solve(known, np.hstack([rates, own @ last.T]))
    left = last @ last.T - (last @ own.T) @ told[:, 3:]
    return other @ (own.T @ told[:, :3]), left


def _parts_by_rates() -> Array:
    """Return the derivatives (20,n) of a rate, its change and an in-frame turn by rates (n,)."""
    rates = shake_functions(_TAU)[1] + MIDDLE_RATES
    shown = np.column_stack([np.ones(len(_TAU)), _TAU, rates @ COMBINATIONS])
    weights = np.gradient(_TAU)
    known = (shown.T * weights) @ shown
    prior = np.diag(np.repeat([1.0, _SIZE**-2], [2, RESOLVED]))
    return np.asarray(np.linalg.solve(known + _USUAL_NOISE * prior, shown.T * weights), np.float64)


_PARTS = _parts_by_rates()


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
    finer = np.empty(2 * len(times[near]) - 1)
    finer[::2], finer[1::2] = times[near], 0.5 * (times[near][1:] + times[near][:-1])
    grid = readout_time * _TAU
    smooth, spread = smoothed(times[near], found[near], finer, grid, spectrum)
    dense, found = (
        np.concatenate([of[: near.start], within, of[near.stop :]])
        for of, within in zip((times, found), (finer, smooth), strict=True)
    )
    delays, weights = _delays(deviation, period)
    # All that follows is by readings that are so much later.
    cubics = spline(dense, found)
    knots = rotations_at_knots(dense, cubics)
    moments = np.append(grid, [0.0, -length]) + delays[:, None]
    _, rates = turns_at(np.clip(moments, dense[0], dense[-1]).ravel(), dense, cubics, knots)
    rates = readout_time * rates.reshape(*moments.shape, 3)
    slopes, rates = (rates[:, -2] - rates[:, -1]) / readout_time, rates[:, :-2]
    late = (_PARTS @ rates).reshape(len(delays), -1)
    # From the last frame to this one, beside a constant.
    steps = 0.5 * (slopes[1:] + slopes[:-1]) * np.diff(delays)[:, None]
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    every = np.hstack([turned, late])
    mean = weights @ every
    off, by_errors = every - mean, np.zeros((every.shape[1], PARAMETERS))
    by_errors[:, DELAY] = -((weights * delays) @ off)[:, None] / (weights @ delays**2)
    off += np.outer(delays, by_errors[:, DELAY.start])
    rest = (off.T * weights) @ off
    if len(delays) > 3:
        found = np.einsum("d,dtx->tx", weights, _at(dense + delays[:, None], dense, found))
        cubics = spline(dense, found)
        knots = rotations_at_knots(dense, cubics)
    turns, _ = turns_at(np.append(readout_time * NODES, -length), dense, cubics, knots)
    usual = (weights @ rates.reshape(len(delays), -1)).reshape(-1, 3)
    within = readout_time * errors.derivatives(usual / readout_time)
    by_errors[WITHIN] += (_PARTS @ within.reshape(len(usual), -1)).reshape(-1, PARAMETERS)
    spread = _PARTS @ (readout_time**2 * spread) @ _PARTS.T
    for axis in range(3):
        rest[WITHIN, WITHIN][axis::3, axis::3] += spread
    between = None
    if length != 0.0:
        between = np.ascontiguousarray(turns[-1].T)
        angle = so3.log(np.ascontiguousarray(turns[-1]))
        # A constant rate in the camera's axes of each moment, seen in those of then.
        by_rate = length * so3.right_jacobian(angle)
        by_errors[BETWEEN] += by_rate @ errors.derivatives(angle / length)[0]
        mean[BETWEEN] = angle
        rest[BETWEEN, BETWEEN] += spectrum.noise * period * abs(length) * np.eye(3)
    squares = np.square(mean).reshape(-1, 3).sum(axis=1)
    rest[np.diag_indices(len(rest))] += _SKEW**2 * np.repeat(squares, 3)
    rest += _JITTER**2 * np.outer(by_errors[:, DELAY.start], by_errors[:, DELAY.start])
    return Read(*parts_of(turns[:-1]), between, by_errors, rest)


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
