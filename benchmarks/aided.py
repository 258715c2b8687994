# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of the independent simulator with an IMU, as the package takes them."""

from dataclasses import dataclass

import numpy as np

from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import Frames, MakeMotions, first_row_times, simulate
from benchmarks.independent.gyroscopes import Imu
from benchmarks.independent.motions import Moving
from benchmarks.independent.scenes import Scene
from rs_localizer.core import camera as core
from rs_localizer.inertial.gyro_prior import GyroscopeTrack
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.status import InertialSettings

_BIAS_WALK = 1e-4  # rad/s^2/sqrt(Hz)
_BEFORE, _AFTER = 0.6, 0.03  # s of samples before the middle row and behind it


def believed(camera: Camera, readout_time: float | None = None) -> core.Camera:
    """The same camera, as the package has it, or with another readout time (s)."""
    return core.Camera(
        camera.width, camera.height, camera.matrix, np.array(camera.distortion),
        readout_time=camera.readout_time if readout_time is None else readout_time,
        scan_direction=camera.scan.value,
    )  # fmt: skip


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

    def aid(self) -> GyroscopeTrack:
        """Return what a tracker knows of the gyroscope before any frame."""
        settings = InertialSettings(self.imu.noise, _BIAS_WALK)
        return GyroscopeTrack(settings, self.frames.camera.readout_time)


def record(
    camera: Camera, make_motions: MakeMotions, scene: Scene, size: tuple[int, int], seed: int,
    imu: Imu | None = None,
) -> Recorded:  # fmt: skip
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
