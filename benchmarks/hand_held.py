# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A hand-held camera in a room, as the measurements of time take it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.data import HAND_MOTION
from rs_localizer.core.camera import Camera
from rs_localizer.io.trajectories import read_tum
from rs_localizer.tools.simulation.frames import SimulatedFrame, simulate_frames
from rs_localizer.tools.simulation.imu import Lever, make_imu, simulate_imu
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.settings import FrameSettings, ImuSettings
from rs_localizer.tools.simulation.true_motion import RecordedMotion, sampled_states

_K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(640, 480, _K, np.array([-0.2, 0.05, 0.0, 0.0, 0.0]), readout_time=0.02)
_NOISE = 0.7  # px
_LANDMARKS = 20_000


@dataclass(frozen=True, slots=True)
class HandHeld:
    """What is simulated: the recorded motion of a hand (TUM VI room5) from its beginning on."""

    points: int  # of each frame
    outliers: float  # share of them
    rate: float  # Hz
    frames: int

    def simulate(self, seed: int = 0) -> Iterator[SimulatedFrame]:
        """The frames; the camera is :data:`CAMERA`."""
        motion = hand_motion()
        world = room(sampled_states(motion).positions, np.random.default_rng(0), count=_LANDMARKS)
        settings = FrameSettings(self.points, _NOISE, self.outliers, self.rate)
        start = motion.intervals_ns[0][0]
        stamps = [start + round(k * 1e9 / self.rate) for k in range(self.frames)]
        return simulate_frames(CAMERA, motion, world, settings, stamps_ns=stamps, seed=seed)

    def readings(self, imu_rate: float, frame: str) -> Iterator[tuple[int, Any]]:
        """Stamps and sensor_msgs/Imu, in the axes of the camera, whose frame has this name."""
        motion = hand_motion()
        settings = ImuSettings(rate=imu_rate)
        lever = Lever(np.eye(3), np.zeros(3))
        track = simulate_imu(motion, settings, lever, np.random.default_rng(0))
        first = int(np.searchsorted(track.times_ns, motion.intervals_ns[0][0]))
        for i in range(first, first + round(self.frames / self.rate * imu_rate)):
            stamp_ns = int(track.times_ns[i])
            rate, force = track.angular_velocities[i], track.specific_forces[i]
            yield stamp_ns, make_imu(stamp_ns, rate, force, settings, frame)


def hand_motion() -> RecordedMotion:
    """Recorded, of a camera in its own axes."""
    return RecordedMotion(read_tum(HAND_MOTION))
