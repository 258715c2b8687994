# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of the independent simulator through the estimator's public interfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.honesty.scores import Score, Scores, Truth, score_at
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import Frames, MakeMotions, first_row_times, simulate
from benchmarks.independent.gyroscopes import Imu
from benchmarks.independent.motions import Moving, States
from benchmarks.independent.scenes import Scene
from rs_localizer.core import camera as core
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.settings import InertialSettings
from rs_localizer.localizer import Localizer
from rs_localizer.tracking import Tracker

_BIAS_WALK = 1e-4  # rad/s^2/sqrt(Hz)
_BEFORE, _AFTER = 0.6, 0.03  # s of samples before the middle row and behind it


@dataclass(frozen=True, slots=True)
class Found:
    """The scores of one condition, at both moments that can be published."""

    stamp: Scores
    middle: Scores


def believed(
    camera: Camera, readout_time: float | None = None, distortion_off: float = 0.0
) -> core.Camera:
    """What the user says of a camera: its lens may be off by a share of its distortion."""
    return core.Camera(
        width=camera.width,
        height=camera.height,
        K=camera.matrix,
        D=(1.0 - distortion_off) * np.array(camera.distortion),
        distortion_model="plumb_bob",
        readout_time=camera.readout_time if readout_time is None else readout_time,
        scan_direction=camera.scan.value,
    )


def scored(frames: Frames, results: dict[int, Estimate | Failure], camera: core.Camera) -> Found:
    """Results against the truth, at the first row and at the middle one."""

    def at(tau: float, states: States) -> Scores:
        scores: list[Score] = []
        for frame, result in results.items():
            truth = truth_of(states, frame)
            recording = int(frames.recording[frame])
            scores.append(score_at(result, tau, camera.readout_time, truth, recording))
        return Scores(scores)

    return Found(at(camera.first_row_time, frames.first), at(0.0, frames.middle))


def truth_of(states: States, frame: int) -> Truth:
    """One of many states."""
    return Truth(*(getattr(states, name)[frame] for name in Truth._fields))


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
        stamps, rates = imu.record(made[0], which, first[0] - 0.3, first[-1] + 0.3, rng)
        samples.append(ImuSamples(stamps + begin, rates))
    return Recorded(frames, tuple(samples), imu)


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """What a tracker made of recordings."""

    scores: Scores  # at the middle row
    time_offsets: list[float]  # s, at the end of each recording


def follow(recorded: Recorded, noise: float, aided: bool, skipped: int) -> Followed:
    """Track all recordings; the first frames of each are not counted."""
    frames, camera = recorded.frames, believed(recorded.frames.camera)
    tracker = Tracker(Localizer(camera), recorded.settings if aided else None)
    scores: list[Score] = []
    offsets: list[float] = []
    for frame in range(len(frames)):
        place, recording = int(frames.place[frame]), int(frames.recording[frame])
        if place == 0:
            tracker.reset()
        points, pixels = frames.seen(frame, noise)
        imu = recorded.around(frame) if aided else None
        found = tracker.localize(frames.middle_ns(frame), points, pixels, imu=imu)
        if place >= skipped:
            truth = truth_of(frames.middle, frame)
            scores.append(score_at(found, 0.0, camera.readout_time, truth, recording))
        if place == frames.place.max() and tracker.inertial is not None:
            offsets.append(tracker.inertial.time_offset)
    return Followed(Scores(scores), offsets)
