# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A moving pinhole camera with a rolling shutter, for the examples that have no camera."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT, READOUT = 640, 480, 0.03  # s from the first row to the last


@dataclass(frozen=True)
class Moving:
    """A camera that sways, a second to either side: at time 0 in the map's axes, as told here."""

    turn: tuple[float, float, float] = (0.4, 1.0, -0.3)  # rad/s, its own axes
    velocity: tuple[float, float, float] = (0.5, 0.2, 0.3)  # m/s, map
    from_body: tuple[float, float, float] = (0.0, 0.0, 0.0)  # rotation vector, camera_from_body

    def position(self, seconds: np.ndarray | float) -> np.ndarray:
        """Of the camera in the map (...,3), m."""
        return np.multiply.outer(np.sin(seconds), self.velocity)

    def see(self, points: np.ndarray, seconds: float) -> np.ndarray:
        """Raw pixels (n,2) of points (n,3), each at the time of its row.

        Args:
            points: in the map, m.
            seconds: when the middle row is exposed.
        """
        pixels = np.tile([WIDTH / 2, HEIGHT / 2], (len(points), 1))
        for _ in range(20):  # the row decides when, and when decides the row
            times = seconds + READOUT * (pixels[:, 1] / (HEIGHT - 1) - 0.5)
            map_from_body = Rotation.from_rotvec(np.outer(np.sin(times), self.turn))
            body = map_from_body.inv().apply(points - self.position(times))
            camera = Rotation.from_rotvec(self.from_body).apply(body)
            pixels = (camera / camera[:, 2:]) @ K.T[:, :2]
        return pixels


def scene(count: int, seed: int = 0) -> np.ndarray:
    """Points (n,3) some metres ahead."""
    rng = np.random.default_rng(seed)
    return rng.uniform([-1.2, -0.9, 3.0], [1.2, 0.9, 6.0], (count, 3))


def matches(
    camera: Moving, points: np.ndarray, seconds: float, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """What a matcher would say: points in the image, pixels with noise, a fifth of them wrong."""
    rng = np.random.default_rng(seed)
    pixels = camera.see(points, seconds) + rng.normal(0.0, 0.5, (len(points), 2))
    wrong = rng.random(len(points)) < 0.2
    pixels[wrong] = rng.uniform([0, 0], [WIDTH, HEIGHT], (wrong.sum(), 2))
    inside = np.all((pixels >= 0) & (pixels <= [WIDTH - 1, HEIGHT - 1]), axis=1)
    return points[inside], pixels[inside]
