# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of the independent simulator with a gyroscope, through tracker and localizer."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from benchmarks.honesty.estimating import believed, truth_of
from benchmarks.honesty.scores import Score, Scores, score_at
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import Frames, MakeMotions, first_row_times, simulate
from benchmarks.independent.gyroscopes import Imu
from benchmarks.independent.motions import Moving
from benchmarks.independent.scenes import Scene
from rs_localizer.core.arrays import Array
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.settings import InertialSettings
from rs_localizer.inertial.turning import GyroscopeErrors, turn_within
from rs_localizer.localizer import Localizer
from rs_localizer.tracking import Tracker

_BIAS_WALK = 1e-4  # rad/s^2/sqrt(Hz)
_BEFORE, _AFTER = 0.6, 0.03  # s of samples before the middle row and behind it
# What a tracker knows of bias and time offset after some seconds.
_BIAS_DEVIATION, _OFFSET_DEVIATION = math.radians(0.05), 5e-5


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """Frames, and the samples of the IMU beside each recording."""

    frames: Frames
    samples: tuple[ImuSamples, ...]
    imu: Imu

    def around(self, frame: int) -> ImuSamples:
        """The samples that come with a frame."""
        every = self.samples[int(self.frames.recording[frame])]
        middle = self.frames.middle_ns(frame)
        first, last = np.searchsorted(
            every.times_ns, [middle - round(1e9 * _BEFORE), middle + round(1e9 * _AFTER)]
        )
        return ImuSamples(every.times_ns[first:last], every.angular_velocity[first:last])

    @property
    def settings(self) -> InertialSettings:
        return InertialSettings(self.imu.noise, _BIAS_WALK, True)


def record(
    camera: Camera,
    make_motions: MakeMotions,
    scene: Scene,
    size: tuple[int, int],
    seed: int,
    imu: Imu | None = None,
) -> Recorded:
    """Simulate recordings and their IMU: so many, and so many frames of each."""
    recordings, length = size
    imu = imu or Imu()
    made: list[Moving] = []

    def remembered(count: int, rng: np.random.Generator) -> Moving:
        made.append(make_motions(count, rng))
        return made[-1]

    frames = simulate(camera, remembered, scene, recordings, length, seed)
    first = first_row_times(camera, length)
    begin = int(frames.stamp_ns[0]) - round(1e9 * first[0])  # time 0 of the motions
    rng = np.random.default_rng(seed)
    samples = []
    for which in range(recordings):
        stamps, rates, _ = imu.record(made[0], which, first[0] - 0.3, first[-1] + 0.3, rng)
        samples.append(ImuSamples(stamps + begin, rates))
    return Recorded(frames, tuple(samples), imu)


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """What a tracker made of recordings."""

    scores: Scores  # at the middle row
    first: Scores  # at the first one
    seconds: list[float]  # of each frame
    time_offsets: list[float]  # s, at the end of each recording


class _Follower:
    """A tracker that goes through recordings, and how good it was."""

    def __init__(self, recorded: Recorded, noise: float, aided: bool, skipped: int) -> None:
        self._recorded, self._noise, self._aided = recorded, noise, aided
        self._skipped = skipped
        self._camera = believed(recorded.frames.camera)
        self._tracker = Tracker(Localizer(self._camera), recorded.settings if aided else None)
        self._middle: list[Score] = []
        self._first: list[Score] = []
        self._seconds: list[float] = []
        self._offsets: list[float] = []

    def localize(self, frame: int) -> None:
        """Localize the next frame."""
        frames, tracker = self._recorded.frames, self._tracker
        place, recording = int(frames.place[frame]), int(frames.recording[frame])
        if place == 0:
            tracker.reset()
        points, pixels = frames.seen(frame, self._noise)
        imu = self._recorded.around(frame) if self._aided else None
        start = time.thread_time()
        found = tracker.localize(frames.middle_ns(frame), points, pixels, imu=imu)
        taken = time.thread_time() - start
        if place >= self._skipped:
            self._seconds.append(taken)
            for scores, states, tau in (
                (self._middle, frames.middle, 0.0),
                (self._first, frames.first, -0.5),
            ):
                truth = truth_of(states, frame)
                scores.append(score_at(found, tau, self._camera.readout_time, truth, recording))
        if place == frames.place.max() and tracker.inertial is not None:
            self._offsets.append(tracker.inertial.time_offset)

    @property
    def followed(self) -> Followed:
        return Followed(Scores(self._middle), Scores(self._first), self._seconds, self._offsets)


def follow(recorded: Recorded, noise: float, aided: bool, skipped: int) -> Followed:
    """Track all recordings; the first frames of each are not counted."""
    follower = _Follower(recorded, noise, aided, skipped)
    for frame in range(len(recorded.frames)):
        follower.localize(frame)
    return follower.followed


def follow_both(recorded: Recorded, noise: float, skipped: int) -> tuple[Followed, Followed]:
    """The same without and with the gyroscope, frame by frame in turn."""
    both = [_Follower(recorded, noise, aided, skipped) for aided in (False, True)]
    for frame in range(len(recorded.frames)):
        for follower in both[:: 1 - 2 * (frame % 2)]:
            follower.localize(frame)
    return both[0].followed, both[1].followed


def alone_and_aided(
    recorded: Recorded, localizer: Localizer, frame: int, points: Array, pixels: Array
) -> tuple[Estimate | Failure, Estimate | Failure]:
    """Results of a single frame without and with a gyroscope that is known by now."""
    deviations = [*3 * [_BIAS_DEVIATION], _OFFSET_DEVIATION]
    errors = GyroscopeErrors(np.zeros(3), 0.0, np.diag(np.square(deviations)), recorded.imu.noise)
    middle_ns, readout_time = recorded.frames.middle_ns(frame), localizer.camera.readout_time
    within = turn_within(recorded.around(frame), middle_ns, readout_time, errors)
    assert within is not None
    return localizer.localize(points, pixels), localizer.localize(points, pixels, turn=within.known)
