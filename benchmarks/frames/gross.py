# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of grossly wrong cameras and maps, for the paired set.

Single frames of a wall, the corner of two, a volume, and ten markers on two walls, seen from 2 m by
a hand-held camera; its focal length is off by 0.5 to 2, a binning or ROI counted twice, or half of
the map was moved. Nothing of the package makes the frames.
"""

from collections.abc import Callable

import cv2
import numpy as np

import rs_localizer as rsl
from rs_localizer.core.arrays import Array

Random = np.random.Generator

_READOUT, _NOISE, _SIZE, _FOCAL = 0.02, 0.1, (640, 480), 500.0
_CENTRE = np.array([319.5, 239.5])


def _turned(vector: Array) -> Array:
    return np.array(cv2.Rodrigues(np.asarray(vector, float))[0], float)


def _wall(random: Random, count: int) -> Array:
    lean = random.uniform(-0.7, 0.7)
    across, along = random.uniform(-1.4, 1.4, count), random.uniform(-1.0, 1.0, count)
    return np.column_stack([across * np.cos(lean), along, 2.2 + across * np.sin(lean)])


def _corner(random: Random, count: int) -> Array:
    along, up = random.uniform(-1.4, 1.4, count), random.uniform(-0.9, 0.9, count)
    return np.column_stack([0.8 * along, up, 3.0 - 0.6 * np.abs(along)])


def _volume(random: Random, count: int) -> Array:
    low, high = (-1.2, -0.9, 1.5), (1.2, 0.9, 3.0)
    return np.asarray(random.uniform(low, high, (count, 3)))


def _markers(random: Random, count: int) -> Array:
    """Corners of markers of 20 cm in two rows on the two walls of a corner."""
    del count
    corners = 0.1 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    places = [(along, up) for along in (-1.1, -0.7, -0.3, 0.35, 0.75) for up in (-0.3, 0.3)]
    flat = np.concatenate([corners + place for place in places])
    return np.column_stack([0.8 * flat[:, 0], flat[:, 1], 2.6 - 0.6 * np.abs(flat[:, 0])])


SCENES: dict[str, Callable[[Random, int], Array]] = {
    "wall": _wall, "corner": _corner, "volume": _volume, "markers": _markers,
}  # fmt: skip


def frame(scene: str, fault: str, random: Random) -> tuple[rsl.Camera, Array, Array, Array]:
    """The camera as it is told, points, pixels, and the rotation of the camera from the map; its
    centre is the origin.
    """
    count = int(random.choice([34, 60, 100]))
    truth = SCENES[scene](random, 3 * count)
    rotation = _turned(random.normal(0.0, 0.1, 3))
    rate, velocity = random.normal(0.0, 0.5, 3) * _READOUT, random.normal(0.0, 0.2, 3) * _READOUT
    pixels, tau = np.zeros((len(truth), 2)), np.zeros(len(truth))
    for _ in range(6):
        moved = np.array([
            _turned(t * rate) @ rotation @ p + t * velocity for t, p in zip(tau, truth, strict=True)
        ])  # fmt: skip
        pixels = _FOCAL * moved[:, :2] / moved[:, 2:] + _CENTRE
        tau = np.clip(pixels[:, 1] / (_SIZE[1] - 1) - 0.5, -0.5, 0.5)
    seen = ((pixels > 0.0) & (pixels < np.array(_SIZE) - 1.0)).all(axis=1)
    kept = np.flatnonzero(seen)[: None if scene == "markers" else count]
    points, pixels = truth[kept].copy(), pixels[kept] + random.normal(0.0, _NOISE, (len(kept), 2))
    focal, centre = _FOCAL, _CENTRE.copy()
    if fault == "focal length":
        focal *= 2.0 ** (random.choice([-1.0, 1.0]) * random.uniform(0.2, 1.0))
    elif fault == "binned twice":
        focal, centre = 0.5 * focal, 0.5 * centre
    elif fault == "ROI twice":
        centre -= random.uniform(40.0, 160.0, 2)
    elif fault == "a tenth wrong":
        wrong = random.choice(len(points), len(points) // 10, replace=False)
        pixels[wrong] = random.uniform(0.0, _SIZE, (len(wrong), 2))
    elif fault == "half moved":
        half = points[:, 0] > np.median(points[:, 0])
        pivot, turn = points[half].mean(axis=0), _turned(random.normal(0.0, 0.2, 3))
        shift = random.normal(0.0, 0.3, 3)
        points[half] = (points[half] - pivot) @ turn.T + pivot + shift
    K = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    return rsl.Camera(*_SIZE, K=K, readout_time=_READOUT), points, pixels, rotation
