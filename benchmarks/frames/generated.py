# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of a condition: points, pixels and the truth, the same for the same seed."""

import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from benchmarks.frames.conditions import Condition, Motion
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import Displaced, Frames, first_row_times, simulate
from benchmarks.independent.motions import IntArray, Moving, States, directions
from benchmarks.independent.rotations import Array, exponential
from benchmarks.independent.scenes import Scene, visible

_MARGIN = 12.0  # px, of wrong points to the edge
_SHIFTED = 0.6  # of the matches of a bad frame
# Of the other body: a person or a vehicle that passes.
_BODY_PLACE, _BODY_SPEED, _BODY_RATE = 0.3, 0.5, math.radians(30.0)
_BENT_METRES = (3.0, 8.0)  # lengths of the waves of a bent map
# A gyroscope of a phone, whose bias and time offset are known by now.
_GYRO_HERTZ, _GYRO_NOISE, _GYRO_BIAS = 400.0, math.radians(0.01), math.radians(0.05)
# Views of a chessboard that is shown to a camera, by whose corners it is calibrated.
_BOARD_TILT, _CORNER_NOISE = math.radians(35.0), 0.1  # rad, px
# Fewer recordings than this say little, however long they are.
_FEWEST = 8


@dataclass(frozen=True, eq=False)
class Gyroscope:
    """Body rates that a gyroscope says of a frame."""

    tau: Array  # (k,) row times
    rates: Array  # (k,3) rad/s
    bias_deviation: float  # rad/s
    rate_deviation: float  # rad/s, of each sample


@dataclass(frozen=True, eq=False)
class Frame:
    """What an estimator gets of one frame, and the truth."""

    recording: int
    place: int  # in its recording
    middle_ns: int
    points: Array  # (n,3)
    pixels: Array  # (n,2)
    counts: bool
    stamp: tuple[Array, ...]  # as ``States``, at the first row
    middle: tuple[Array, ...]
    gyroscope: Gyroscope | None


def generate(condition: Condition, frames: int, seed: int) -> Iterator[Frame]:
    """At least so many frames that count, one recording after the other."""
    first, last = condition.sequence.counted
    if condition.sequence.length == 1:
        recordings = frames
    else:
        recordings = max(min(_FEWEST, frames), -(-frames // (last - first)))
    made = _simulated(
        condition.camera, condition.motion, condition.scene, recordings, condition.sequence.length,
        seed, condition.points.body,
    )  # fmt: skip
    key = zlib.crc32(f"{condition.bench}/{condition.name}".encode())
    spoil = _Spoiler(condition, recordings, np.random.default_rng([seed, key]))
    for frame in range(len(made.frames)):
        place = int(made.frames.place[frame])
        recording, measured = int(made.frames.recording[frame]), spoil(made.frames, frame)
        states = _state(made.frames.first, frame), _state(made.frames.middle, frame)
        gyroscope = _gyroscope(made, frame, spoil.rng) if condition.points.gyroscope else None
        middle_ns, counts = made.frames.middle_ns(frame), first <= place < last
        yield Frame(recording, place, middle_ns, *measured, counts, *states, gyroscope)


@dataclass(frozen=True, eq=False)
class _Made:
    frames: Frames
    motions: Moving
    times: Array  # (f,) s of the middle rows


@lru_cache(maxsize=4)
def _simulated(
    camera: Camera, motion: Motion, scene: Scene, recordings: int, length: int, seed: int,
    body: float,
) -> _Made:  # fmt: skip
    made: list[Moving] = []

    def remembered(count: int, rng: np.random.Generator) -> Moving:
        made.append(motion(count, rng))
        return made[0]

    key = zlib.crc32(repr((camera, motion, scene, length)).encode())
    number = int(np.random.SeedSequence([seed, key]).generate_state(1)[0])
    other = _other_body(recordings, np.random.default_rng([seed, key]), body) if body else None
    frames = simulate(camera, remembered, scene, recordings, length, number, other)
    times = first_row_times(camera, length)[frames.place] + 0.5 * camera.readout_time
    return _Made(frames, made[0], times)


def _other_body(recordings: int, rng: np.random.Generator, share: float) -> Displaced:
    """A share of the points turns about their middle, moves on, and was elsewhere in the map."""
    aside = _BODY_PLACE * directions(recordings, rng)
    velocity = _BODY_SPEED * directions(recordings, rng)
    rate = _BODY_RATE * directions(recordings, rng)

    def displaced(true: Array, time: Array, which: IntArray) -> Array:
        count = round(share * true.shape[1])
        own, now = true[:, :count], time[:, :count, None]
        middle = own.mean(axis=1, keepdims=True)
        turned = exponential(now * rate[which][:, None]) @ (own - middle)[..., None]
        moved = middle + turned[..., 0] + aside[which][:, None] + now * velocity[which][:, None]
        return np.concatenate([moved, true[:, count:]], axis=1)

    return displaced


class _Spoiler:
    """Makes measurements of exact frames: noise, wrong matches, a map that is off."""

    def __init__(self, condition: Condition, recordings: int, rng: np.random.Generator) -> None:
        self._condition, self.rng = condition, rng
        angle = rng.uniform(0.0, 2.0 * np.pi, (recordings, 1))
        self._direction = np.hstack([np.cos(angle), np.sin(angle)])
        self._map = _BentMap(recordings, rng)

    def __call__(self, frames: Frames, frame: int) -> tuple[Array, Array]:
        """Points (n,3) and pixels (n,2)."""
        condition, points, rng = self._condition, self._condition.points, self.rng
        recording, place = int(frames.recording[frame]), int(frames.place[frame])
        shown = frames.visible[frame]
        noise = condition.noise * frames.unit_noise[frame, shown]
        if np.isfinite(points.tails):
            # Both coordinates of a point are bad together: a multivariate t.
            spread = rng.chisquare(points.tails, (len(noise), 1)) / points.tails
            noise = noise / np.sqrt(spread)
        pixels = frames.exact[frame, shown] + noise + points.shift * self._direction[recording]
        mapped = frames.points[frame, shown]
        rough = points.rough_map * rng.normal(size=mapped.shape)
        mapped = mapped + (rough + points.bent_map * self._map(mapped, recording))
        begin, end, shift = condition.sequence.bad
        if begin <= place < end:
            some = rng.permutation(len(pixels))[: round(_SHIFTED * len(pixels))]
            pixels[some] += shift * self._direction[recording]
        share, shift = points.alike
        if share:
            some = rng.permutation(len(pixels))[: round(share * len(pixels))]
            pixels[some] += shift * self._direction[recording]
        share, shift = points.near
        if share:
            some = rng.permutation(len(pixels))[: round(share * len(pixels))]
            angle = rng.uniform(0.0, 2.0 * np.pi, len(some))
            far = shift * np.sqrt(rng.uniform(size=len(some)))  # anywhere in a circle
            pixels[some] += far[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        share, cell = points.slip
        if share:
            mapped = _slipped(mapped, pixels, self._direction[recording], share, cell)
        count = round(points.wrong * len(pixels))
        if count:
            far = np.array([frames.camera.width, frames.camera.height]) - 1.0 - _MARGIN
            some = rng.permutation(len(pixels))[:count]
            pixels[some] = rng.uniform(_MARGIN, far, (count, 2))
        return mapped, pixels


def _slipped(mapped: Array, pixels: Array, direction: Array, share: float, cell: float) -> Array:
    """Points (n,3) with those farthest to one side of the image moved by a cell (m) along it."""
    side = np.argsort(-(pixels @ direction))[: round(share * len(pixels))]
    plane = np.linalg.lstsq(pixels - pixels.mean(axis=0), mapped - mapped.mean(axis=0))[0]
    along = direction @ plane
    moved = mapped.copy()
    moved[side] += cell * along / np.linalg.norm(along)
    return moved


class _BentMap:
    """Long waves through space, of deviation 1 in each coordinate."""

    def __init__(self, recordings: int, rng: np.random.Generator) -> None:
        number = 2.0 * np.pi / rng.uniform(*_BENT_METRES, (recordings, 6, 1))
        self._waves = number * directions(recordings * 6, rng).reshape(recordings, 6, 3)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, (recordings, 6))
        self._way = rng.normal(size=(recordings, 6, 3)) / math.sqrt(3.0)

    def __call__(self, places: Array, recording: int) -> Array:
        waves = np.sin(places @ self._waves[recording].T + self._phase[recording])
        return np.asarray(waves @ self._way[recording])


def calibrated(camera: Camera, boards: int, seed: int) -> tuple[Array, Array]:
    """Matrix and distortion that OpenCV finds of views of a chessboard at rest."""
    rng = np.random.default_rng(seed)
    columns, rows = np.meshgrid(np.linspace(-0.25, 0.25, 9), np.linspace(-0.156, 0.156, 6))
    flat = np.column_stack([columns.ravel(), rows.ravel(), np.zeros(columns.size)])
    views: list[Array] = []
    while len(views) < boards:
        turned = exponential(_BOARD_TILT * rng.uniform(-1.0, 1.0, 3))
        place = rng.uniform([-0.4, -0.3, 0.4], [0.4, 0.3, 0.9])
        pixels = camera.project(flat @ turned.T + place)
        if visible(camera, pixels).all():
            views.append(pixels + _CORNER_NOISE * rng.normal(size=pixels.shape))
    _, matrix, distortion, _, _ = cv2.calibrateCamera(
        [flat.astype(np.float32)] * boards, [one.astype(np.float32) for one in views],
        (camera.width, camera.height), camera.matrix, np.zeros(5),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3,
    )  # fmt: skip
    return np.array(matrix, np.float64), np.array(distortion, np.float64).ravel()


def _state(states: States, frame: int) -> tuple[Array, ...]:
    every = (states.rotation, states.position, states.angular, states.linear)
    return tuple(each[frame] for each in every)


def _gyroscope(made: _Made, frame: int, rng: np.random.Generator) -> Gyroscope:
    readout = made.frames.camera.readout_time
    delays = np.arange(-readout, readout, 1.0 / _GYRO_HERTZ)
    which = np.full(len(delays), made.frames.recording[frame])
    rates = made.motions.states(which, made.times[frame] + delays).angular
    bias = _GYRO_BIAS * rng.normal(size=3)
    deviation = _GYRO_NOISE * math.sqrt(_GYRO_HERTZ)
    noise = deviation * rng.normal(size=rates.shape)
    return Gyroscope(delays / readout, rates + bias + noise, _GYRO_BIAS, deviation)
