# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What a gyroscope and an accelerometer beside the camera show of its motion."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.independent.motions import IntArray, Moving
from benchmarks.independent.rotations import Array

GRAVITY = np.array([0.0, 0.0, -9.80665])  # m/s^2, in the map
_STEP = 1e-4  # s, for accelerations by differences


@dataclass(frozen=True, slots=True)
class Imu:
    """An IMU as it really is; its axes are the camera's."""

    rate: float = 400.0  # Hz
    noise: float = math.radians(0.01)  # rad/s/sqrt(Hz) of the gyroscope
    bias: float = math.radians(0.5)  # rad/s, length of the gyroscope's
    offset: float = 0.0  # s that its stamps are early: to be added to them
    force_noise: float = 0.002  # m/s^2/sqrt(Hz)

    def record(
        self, motions: Moving, which: int, first: float, last: float, rng: np.random.Generator
    ) -> tuple[IntArray, Array, Array]:
        """Stamps (n,) in ns, angular velocities (n,3), specific forces (n,3) of one camera.

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
        shown = states.angular + bias + deviation * rng.normal(size=(len(times), 3))
        pushed = _accelerations(motions, camera, times) - GRAVITY
        force = np.einsum("nji,nj->ni", states.rotation, pushed)
        force += self.force_noise * math.sqrt(self.rate) * rng.normal(size=force.shape)
        return np.rint(1e9 * (times - self.offset)).astype(np.int64), shown, force


def _accelerations(motions: Moving, which: IntArray, times: Array) -> Array:
    """Of the camera's places (n,3), m/s^2 in the map."""
    before, here, after = (motions.poses(which, times + step)[1] for step in (-_STEP, 0.0, _STEP))
    found: Array = (before - 2.0 * here + after) / _STEP**2
    return found
