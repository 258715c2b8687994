# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A camera that turns as a known function of time says, projected by the tests' own means."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.inertial.samples import ImuSamples

READOUT_TIME = 0.03
MIDDLE_NS = 10**12


class Shaken:
    """A hand's turn and a vibration of 0.3 deg at 60 Hz about one axis each, 0.5 m/s."""

    def __init__(self, vibration=0.3, turn=40.0):
        self.vibration, self.turn = np.radians(vibration), np.radians(turn)
        self.start = Rotation.from_rotvec([0.3, -0.2, 0.5])
        self.velocity = np.array([0.3, -0.4, 0.1])

    def pose(self, time):
        """map_from_camera Rotation and position at a time (s)."""
        swing = self.vibration * np.sin(2.0 * np.pi * 60.0 * time + 0.7)
        local = Rotation.from_rotvec([0.0, 0.0, self.turn * time]) * Rotation.from_rotvec(
            swing * np.array([0.6, 0.8, 0.0])
        )
        return self.start * local, np.array([0.1, 0.2, -3.0]) + self.velocity * time

    def rate(self, time):
        """Body rate (3,) rad/s by differences."""
        step = 1e-6
        before, after = self.pose(time - step)[0], self.pose(time + step)[0]
        return (before.inv() * after).as_rotvec() / (2.0 * step)

    def samples(self, rate=4000.0, reach=0.06):
        """A noise-free gyroscope about the middle row."""
        times = np.arange(-round(reach * rate), round(reach * rate) + 1) / rate
        rates = np.array([self.rate(time) for time in times])
        return ImuSamples(MIDDLE_NS + np.rint(1e9 * times).astype(np.int64), rates)

    def frame(self, camera, count=60, seed=0):
        """Points (n,3) and raw pixels (n,2), each exposed with its own row."""
        rng = np.random.default_rng(seed)
        rotation, position = self.pose(0.0)
        local = np.column_stack(
            [rng.uniform(-1.2, 1.2, count), rng.uniform(-0.9, 0.9, count), np.ones(count)]
        ) * rng.uniform(2.0, 5.0, (count, 1))
        points = rotation.apply(0.45 * local * [1.0, 1.0, 1.0 / 0.45]) + position
        pixels = []
        for point in points:
            time = 0.0
            for _ in range(60):
                rotation, position = self.pose(time)
                seen = rotation.inv().apply(point - position)
                pixel = camera.K[:2, :2] @ (seen[:2] / seen[2]) + camera.K[:2, 2]
                time = READOUT_TIME * (pixel[1] / (camera.height - 1) - 0.5)
            pixels.append(pixel)
        return points, np.array(pixels)


@pytest.fixture
def camera():
    K = np.array([[420.0, 0.0, 319.5], [0.0, 420.0, 239.5], [0.0, 0.0, 1.0]])
    return Camera(width=640, height=480, K=K, readout_time=READOUT_TIME)
