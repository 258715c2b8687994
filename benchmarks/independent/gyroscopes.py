# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What a gyroscope and an accelerometer beside the camera show of its motion."""

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.independent.motions import IntArray, Moving
from benchmarks.independent.rotations import Array, exponential


@dataclass(frozen=True, slots=True)
class Imu:
    """An IMU as it really is; its axes are the camera's."""

    rate: float = 400.0  # Hz
    noise: float = math.radians(0.01)  # rad/s/sqrt(Hz) of the gyroscope
    bias: float = math.radians(0.5)  # rad/s, length of the gyroscope's
    offset: float = 0.0  # s that its stamps are early: to be added to them
    scale: float = 1.0  # of the rates that it shows to the true ones
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)  # rad that it is turned on its mount
    axes: tuple[int, int, int] = (1, 2, 3)  # of the camera, which it shows as x, y, z; or their -
    step: float = 0.0  # s by which its stamps are later after time 0
    limit: float = math.inf  # rad/s, the end of its range

    def record(
        self, motions: Moving, which: int, first: float, last: float, rng: np.random.Generator
    ) -> tuple[IntArray, Array]:
        """Stamps (n,) in ns and angular velocities (n,3) of one camera.

        Args:
            first, last: s, time of its motion.
        """
        times = np.arange(math.floor(first * self.rate), math.ceil(last * self.rate) + 1.0)
        times = (times + rng.uniform()) / self.rate
        camera = np.full(len(times), which)
        states = motions.states(camera, times)
        direction = rng.normal(size=3)
        bias = self.bias * direction / np.linalg.norm(direction)
        deviation = self.noise * math.sqrt(self.rate)
        turned = self.scale * states.angular @ exponential(np.array(self.mount))
        axes = np.array(self.axes)
        turned = np.sign(axes) * turned[:, np.abs(axes) - 1]
        shown = turned + bias + deviation * rng.normal(size=(len(times), 3))
        shown = np.clip(shown, -self.limit, self.limit)
        stamps = times - self.offset + self.step * (times > 0.0)
        return np.rint(1e9 * stamps).astype(np.int64), shown
