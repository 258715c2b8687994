# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A hand that carries camera and IMU, by formulas of its own: what both would measure, exactly.

Nothing of it is the package's code, but for the spline that the camera's motion is handed over in.
The map has a size and an orientation of its own: gravity points anywhere in it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.trajectory.spline import Layout, Spline

GRAVITY = 9.80665  # m/s^2
# Sines of a second or so, in three angles (rad) and three coordinates (m).
TURN, WAY = 0.2, 0.06
MAP_FROM_WORLD = Rotation.from_rotvec([0.4, -1.9, 0.8])
CAMERA_FROM_IMU = Rotation.from_rotvec([0.3, -1.2, 0.7])
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Felt:
    """A motion in metres with z up, a map of it in other units and axes, an IMU on the camera."""

    frequencies: np.ndarray  # (6,4) rad/s
    phases: np.ndarray
    scale: float = 0.37  # m per unit of the map
    map_from_world: Rotation = MAP_FROM_WORLD
    camera_from_imu: Rotation = CAMERA_FROM_IMU
    lever: tuple[float, float, float] = (0.06, -0.04, 0.08)  # m, camera axes
    bias: tuple[float, float, float] = (0.2, -0.15, 0.16)  # m/s^2, 0.3 long
    gyroscope_bias: tuple[float, float, float] = (0.02, -0.01, 0.03)  # rad/s
    delay: float = 0.005  # s, to be added to stamps of the IMU
    turn: float = TURN
    way: float = WAY

    @staticmethod
    def random(seed: int, **other: Any) -> "Felt":
        rng = np.random.default_rng(seed)
        frequencies = 2.0 * np.pi * rng.uniform(0.15, 1.3, (6, 4))
        return Felt(frequencies, rng.uniform(0.0, 6.28, (6, 4)), **other)

    def _sines(self, t: np.ndarray) -> np.ndarray:
        return np.sum(np.sin(self.frequencies * t[:, None, None] + self.phases), axis=2)

    def world(self, t: np.ndarray) -> tuple[Rotation, np.ndarray]:
        """World from camera, and where its centre is, m."""
        x = self._sines(np.asarray(t, float))
        tilt = Rotation.from_euler("x", -1.4)  # cameras look ahead
        return Rotation.from_euler("ZYX", self.turn * x[:, :3]) * tilt, self.way * x[:, 3:]

    def spline(self, seconds: float, spacing: float = 0.005) -> Spline:
        """The camera in the map."""
        layout = Layout.over(np.array([[0.0, seconds]]), spacing)
        rotations, places = self.world(layout.control_times())
        in_map = self.map_from_world * rotations
        return Spline(layout, in_map.as_matrix(), self.map_from_world.apply(places) / self.scale)

    @property
    def down(self) -> np.ndarray:
        """Unit vector along gravity in the map."""
        return self.map_from_world.apply([0.0, 0.0, -1.0])

    def stamps(self, seconds: float, rate: float = 200.0) -> np.ndarray:
        """Of samples, s, by the IMU's clock, from before the images to after them."""
        return np.arange(-0.6, seconds + 0.6, 1.0 / rate)

    def rates(self, stamps: np.ndarray) -> np.ndarray:
        """What the gyroscope shows, rad/s."""
        t, h = stamps + self.delay, 1e-4
        before, after = (self.world(t + shift)[0] * self.camera_from_imu for shift in (-h, h))
        return (before.inv() * after).as_rotvec() / (2.0 * h) + self.gyroscope_bias

    def forces(self, stamps: np.ndarray) -> np.ndarray:
        """What the accelerometer shows, m/s^2: the second difference of its own way, less gravity,
        in its axes.
        """
        t, h = stamps + self.delay, 1e-3

        def place(shift: float) -> np.ndarray:
            rotations, places = self.world(t + shift)
            return places + rotations.apply(self.lever)

        acceleration = (place(h) - 2.0 * place(0.0) + place(-h)) / h**2
        axes = self.world(t)[0] * self.camera_from_imu
        return axes.inv().apply(acceleration + GRAVITY * UP) + self.bias
