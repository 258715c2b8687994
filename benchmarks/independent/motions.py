# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Motions of many cameras at once: sums of sines, sudden stops, hits, and recorded ones.

The rotation vector of a camera and its place both are sums of sines in time plus a steady part
that may stop, so pose, velocities and accelerations are known exactly at every instant.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_lsq_spline
from scipy.spatial.transform import Rotation

from benchmarks.independent.rotations import Array, body_rate, exponential, logarithm

_SINES = 4
# A hand: 67 deg/s (median), 9 rad/s^2 (rms), 0.45 m/s and 3 m/s^2 (rms).
_HAND_HERTZ = (0.4, 2.0)
_HAND_RATE, _HAND_SPEED = 1.32, 0.45  # rad/s, m/s; rms of the vectors
# A drone drifts while it hovers: 10 deg/s and 0.3 m/s (rms).
_DRIFT_HERTZ = (0.2, 0.5)
_DRIFT_RATE, _DRIFT_SPEED = math.radians(10.0), 0.3
# A turn of 60 deg/s and a move of 0.5 m/s that end within 20 to 40 ms.
_STOPPED_RATE, _STOPPED_SPEED = math.radians(60.0), 0.5
_STOP_SECONDS = (0.02, 0.04)
# Sines of a coloured noise: enough that their sum is as good as Gaussian.
_COLOURS = 40
# How a light camera mount rings when it is hit.
_RINGING_HERTZ, _RINGING_SECONDS = (30.0, 120.0), (0.01, 0.03)

IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """n cameras at an instant each."""

    rotation: Array  # (n,3,3) map_from_camera
    position: Array  # (n,3) m
    angular: Array  # (n,3) rad/s, of the camera with respect to the map, camera axes
    linear: Array  # (n,3) m/s, likewise


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """m motions; first three columns: rotation vector (rad), last three: place (m).

    At time 0 every camera has its first pose: ``rotation``, ``position``.
    """

    rotation: Array  # (m,3,3) map_from_camera
    position: Array  # (m,3)
    amplitude: Array  # (m,k,6) of k sines
    frequency: Array  # (m,k) rad/s
    phase: Array  # (m,k,6)
    steady: Array  # (m,6) per second
    stop: Array  # (m,) s, when the steady part begins to stop; infinite: never
    stopping: Array  # (m,) s, how long that takes

    def __len__(self) -> int:
        return len(self.rotation)

    def poses(self, which: IntArray, time: Array) -> tuple[Array, Array]:
        """Rotations (n,3,3) and positions (n,3) of cameras (n,) at times (n,)."""
        way = self._way(which, time)
        turned = self.rotation[which] @ exponential(way[:, :3])
        return turned, self.position[which] + way[:, 3:]

    def states(self, which: IntArray, time: Array) -> States:
        """Poses and twists of cameras (n,) at times (n,)."""
        rotation, position = self.poses(which, time)
        rate = self._rate(which, time)
        linear = np.einsum("nji,nj->ni", rotation, rate[:, 3:])
        turn = body_rate(self._way(which, time)[:, :3], rate[:, :3])
        return States(rotation, position, turn, linear)

    def _way(self, which: IntArray, time: Array) -> Array:
        frequency, phase = self.frequency[which][:, :, None], self.phase[which]
        waves = np.sin(frequency * time[:, None, None] + phase) - np.sin(phase)
        way: Array = np.sum(self.amplitude[which] * waves, axis=1)
        travelled = self._travelled(which, time) - self._travelled(which, np.zeros_like(time))
        return way + self.steady[which] * travelled[:, None]

    def _rate(self, which: IntArray, time: Array) -> Array:
        frequency = self.frequency[which][:, :, None]
        angle = frequency * time[:, None, None] + self.phase[which]
        rate = np.sum(self.amplitude[which] * frequency * np.cos(angle), axis=1)
        return np.asarray(rate + self.steady[which] * self._still_moving(which, time)[:, None])

    def _still_moving(self, which: IntArray, time: Array) -> Array:
        """Share (n,) of the steady velocity that is left: half a cosine from 1 to 0."""
        phase = np.clip((time - self.stop[which]) / self.stopping[which], 0.0, 1.0)
        return np.asarray(0.5 + 0.5 * np.cos(np.pi * phase))

    def _travelled(self, which: IntArray, time: Array) -> Array:
        """Its integral, from any instant."""
        start = np.where(np.isfinite(self.stop[which]), self.stop[which], 0.0)
        never = ~np.isfinite(self.stop[which])
        since, duration = time - start, self.stopping[which]
        braking = np.clip(since, 0.0, duration)
        way = 0.5 * braking + duration / (2.0 * np.pi) * np.sin(np.pi * braking / duration)
        return np.asarray(np.where(never | (since < 0.0), since, way))


@dataclass(frozen=True, slots=True, eq=False)
class Struck(Motions):
    """The same, each camera hit once: from then on it rings, and that dies away."""

    swing: Array  # (m,3) rad
    ringing: Array  # (m,) rad/s
    hit: Array  # (m,) s
    fading: Array  # (m,) s

    def _way(self, which: IntArray, time: Array) -> Array:
        way = Motions._way(self, which, time)
        way[:, :3] += self._rung(which, time)[0][:, None] * self.swing[which]
        return way

    def _rate(self, which: IntArray, time: Array) -> Array:
        rate = Motions._rate(self, which, time)
        rate[:, :3] += self._rung(which, time)[1][:, None] * self.swing[which]
        return rate

    def _rung(self, which: IntArray, time: Array) -> tuple[Array, Array]:
        """Share (n,) of the swing, and its change (n,) per second."""
        since = np.maximum(time - self.hit[which], 0.0)
        ringing, fading = self.ringing[which], self.fading[which]
        faded, angle = np.exp(-since / fading), ringing * since
        change = faded * (ringing * np.cos(angle) - np.sin(angle) / fading)
        return faded * np.sin(angle), np.where(time > self.hit[which], change, 0.0)


class Recorded:
    """Cameras that move as a recorded one did, each from another moment on.

    Cubic splines through its poses, a knot every 50 ms: motion capture shakes from sample to
    sample, hands do not. Time 0 of a camera lies within a stretch without gaps, with as much time
    on both sides as it is to be asked for.
    """

    _KNOTS, _GAP, _STEP = 0.05, 3.0, 1e-5  # s; samples; s

    def __init__(self, samples: Array, count: int, rng: np.random.Generator, around: float) -> None:
        """From samples (n,8): time (s), position (m), quaternion (x, y, z, w)."""
        times = samples[:, 0]
        gaps = np.flatnonzero(np.diff(times) > self._GAP * np.median(np.diff(times))) + 1
        stretches = [s for s in np.split(samples, gaps) if np.ptp(s[:, 0]) > 2.0 * around + 1.0]
        longest = np.array([np.ptp(s[:, 0]) - 2.0 * around for s in stretches])
        self._stretch = rng.choice(len(stretches), count, p=longest / longest.sum())
        self._splines = [self._spline(s) for s in stretches]
        self._start = around + longest[self._stretch] * rng.uniform(size=count)
        every = np.arange(count)
        self.rotation, self.position = self.poses(every, np.zeros(count))

    def __len__(self) -> int:
        return len(self._start)

    def poses(self, which: IntArray, time: Array) -> tuple[Array, Array]:
        """Rotations (n,3,3) and positions (n,3) of cameras (n,) at times (n,)."""
        values = np.empty((len(which), 7))
        for index, spline in enumerate(self._splines):
            here = self._stretch[which] == index
            values[here] = spline(self._start[which[here]] + time[here])
        return Rotation.from_quat(values[:, 3:]).as_matrix(), values[:, :3]

    def states(self, which: IntArray, time: Array) -> States:
        """Poses and twists of cameras (n,) at times (n,)."""
        rotation, position = self.poses(which, time)
        before, after = (self.poses(which, time + step) for step in (-self._STEP, self._STEP))
        turn = logarithm(np.swapaxes(before[0], 1, 2) @ after[0]) / (2.0 * self._STEP)
        way = (after[1] - before[1]) / (2.0 * self._STEP)
        return States(rotation, position, turn, np.einsum("nji,nj->ni", rotation, way))

    def _spline(self, samples: Array) -> BSpline:
        quaternions = samples[:, 4:]
        turned = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
        signs = np.cumprod(np.r_[1.0, np.where(turned, -1.0, 1.0)])
        times = samples[:, 0] - samples[0, 0]
        inner = np.linspace(0.0, times[-1], int(times[-1] / self._KNOTS))
        knots = np.r_[[0.0] * 3, inner, [times[-1]] * 3]
        values = np.column_stack([samples[:, 1:4], signs[:, None] * quaternions])
        return make_lsq_spline(times, values, knots)


Moving = Motions | Recorded


def rest(count: int, rng: np.random.Generator) -> Motions:
    """Cameras that do not move."""
    return _motions(count, rng, _no_waves(count))


def hand(count: int, rng: np.random.Generator, slower: float = 1.0) -> Motions:
    """Cameras in a hand; ``slower`` divides its velocities and accelerations."""
    waves = _waves(count, rng, _HAND_HERTZ, _HAND_RATE / slower, _HAND_SPEED / slower)
    return _motions(count, rng, waves)


def vibration(
    count: int, rng: np.random.Generator, degrees: float | Array, hertz: float | Array
) -> Motions:
    """Cameras on a hovering drone that shakes them to and fro by an angle, about any axis.

    ``degrees`` and ``hertz``: of all, or of each (count,).
    """
    amplitude, frequency = _waves(count, rng, _DRIFT_HERTZ, _DRIFT_RATE, _DRIFT_SPEED)
    shaking = np.zeros((count, 1, 6))
    swing = np.radians(np.full(count, degrees))
    shaking[:, 0, :3] = swing[:, None] * directions(count, rng)
    amplitude = np.concatenate([amplitude, shaking], axis=1)
    frequency = np.column_stack([frequency, np.full(count, 2.0 * np.pi * hertz)])
    return _motions(count, rng, (amplitude, frequency), in_step=True)


def any_vibration(
    count: int, rng: np.random.Generator, degrees: tuple[float, float],
    hertz: tuple[float, float], tones: int = 1,
) -> Motions:  # fmt: skip
    """The same by some tones between these limits, one camera another than the next."""
    drawn = [
        np.exp(rng.uniform(math.log(low), math.log(high), (tones, count)))
        for low, high in (degrees, hertz)
    ]
    each = [vibration(count, rng, *one) for one in zip(*drawn, strict=True)]
    return _with_last_of(each[0], each[1:])


def shaken_hand(
    count: int, rng: np.random.Generator, shaking: tuple[tuple[float, float], ...]
) -> Motions:
    """Cameras in a hand that vibrate besides, each vibration (degrees, hertz) about any axis."""
    held = hand(count, rng)
    return _with_last_of(held, [vibration(count, rng, *one) for one in shaking])


def coloured(
    count: int, rng: np.random.Generator, degrees: float, hertz: tuple[float, float]
) -> Motions:
    """Cameras on a drone that shakes at random, by an angle (rms), as much in every octave."""
    low, high = np.log(hertz)
    frequency = np.exp(rng.uniform(low, high, (count, _COLOURS)))
    amplitude = np.zeros((count, _COLOURS, 6))
    amplitude[..., :3] = math.radians(degrees) * math.sqrt(2.0 / (3.0 * _COLOURS))
    drift, slow = _waves(count, rng, _DRIFT_HERTZ, _DRIFT_RATE, _DRIFT_SPEED)
    waves = np.concatenate([drift, amplitude], axis=1)
    return _motions(count, rng, (waves, np.column_stack([slow, 2.0 * np.pi * frequency])))


def struck(
    count: int, rng: np.random.Generator, degrees: float, earliest: float, latest: float
) -> Struck:
    """Cameras in a hand that are hit some time between the two (s), and ring by an angle."""
    held = hand(count, rng)
    return Struck(
        **{item.name: getattr(held, item.name) for item in fields(Motions)},
        swing=math.radians(degrees) * directions(count, rng),
        ringing=2.0 * np.pi * rng.uniform(*_RINGING_HERTZ, count),
        hit=rng.uniform(earliest, latest, count),
        fading=rng.uniform(*_RINGING_SECONDS, count),
    )


def steady(count: int, rng: np.random.Generator, rate: float, speed: float) -> Motions:
    """Cameras that turn (rad/s) and move (m/s) steadily, in any direction."""
    velocities = [rate * directions(count, rng), speed * directions(count, rng)]
    return _motions(count, rng, _no_waves(count), np.column_stack(velocities))


def sudden_stop(count: int, rng: np.random.Generator, earliest: float, latest: float) -> Motions:
    """Cameras that turn and move steadily until they stop, some time between the two (s)."""
    velocities = [_STOPPED_RATE * directions(count, rng), _STOPPED_SPEED * directions(count, rng)]
    stop = rng.uniform(earliest, latest, count), rng.uniform(*_STOP_SECONDS, count)
    return _motions(count, rng, _no_waves(count), np.column_stack(velocities), stop)


def _with_last_of(first: Motions, others: Sequence[Motions]) -> Motions:
    """Motions with the last sine of others besides."""
    joined = {}
    for name in ("amplitude", "frequency", "phase"):
        last = (getattr(other, name)[:, -1:] for other in others)
        joined[name] = np.concatenate([getattr(first, name), *last], axis=1)
    return replace(first, **joined)


def directions(count: int, rng: np.random.Generator) -> Array:
    """Unit vectors (count,3) of any direction."""
    vectors = rng.normal(size=(count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _no_waves(count: int) -> tuple[Array, Array]:
    return np.zeros((count, 1, 6)), np.ones((count, 1))


def _waves(
    count: int, rng: np.random.Generator, hertz: tuple[float, float], rate: float, speed: float
) -> tuple[Array, Array]:
    """Amplitudes and frequencies whose velocities have these rms values, all sines the same."""
    low, high = np.log(hertz)
    frequency = 2.0 * np.pi * np.exp(rng.uniform(low, high, (count, _SINES)))
    rms = np.repeat([rate, speed], 3) / math.sqrt(3.0)
    amplitude = rms * math.sqrt(2.0 / _SINES) / frequency[:, :, None]
    return amplitude, frequency


def _motions(
    count: int, rng: np.random.Generator, waves: tuple[Array, Array], steady: Array | None = None,
    stop: tuple[Array, Array] | None = None, in_step: bool = False,
) -> Motions:  # fmt: skip
    """From any first pose.

    Args:
        count: how many.
        rng: source of chance.
        waves: amplitudes (count,k,6) and frequencies (count,k), rad/s, of the sines.
        steady: (count,6) velocities; None: zero.
        stop: when they stop (count,) and for how long they brake, s; None: they do not.
        in_step: the last sine shakes all axes at once, about one line.
    """
    amplitude, frequency = waves
    when, braking = (np.full(count, np.inf), np.ones(count)) if stop is None else stop
    phase = rng.uniform(0.0, 2.0 * np.pi, amplitude.shape)
    if in_step:
        phase[:, -1] = phase[:, -1, :1]
    rotation = exponential(rng.uniform(0.0, 3.0, (count, 1)) * directions(count, rng))
    position = rng.uniform(-3.0, 3.0, (count, 3))
    steady = np.zeros((count, 6)) if steady is None else steady
    return Motions(rotation, position, amplitude, frequency, phase, steady, when, braking)
