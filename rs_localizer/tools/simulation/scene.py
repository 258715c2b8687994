# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Scenes: fixed maps of 3D points around the path of a simulated camera."""

import numpy as np

from rs_localizer.core.arrays import Array

# Points of the map; enough that a narrow camera close to a wall still sees some hundreds.
_POINTS = 30_000
# Walls stand this far beyond the path of the camera (m); rooms as people record them in.
_WALL_DISTANCE = (1.5, 3.0)
# Share of the points that stand about in the room, as boxes, instead of on the walls.
_CLUTTER = 0.5
_BOXES = 120
_BOX_SIZE = (0.1, 0.8)
# Unevenness of the walls (m): pictures, shelves, pipes.
_RELIEF = 0.1
# Least distance (m) of anything from the path of the camera.
_CLEARANCE = 0.8


def room(positions: Array, rng: np.random.Generator, count: int = _POINTS) -> Array:
    """Return points (count,3) on walls of a room and boxes in it, around positions (n,3).

    The same positions and generator state give the same room.
    """
    low = positions.min(axis=0) - rng.uniform(*_WALL_DISTANCE, size=3)
    high = positions.max(axis=0) + rng.uniform(*_WALL_DISTANCE, size=3)
    clutter = _boxes(low, high, positions, int(_CLUTTER * count), rng)
    return np.concatenate([clutter, _walls(low, high, count - len(clutter), rng)])


def _walls(low: Array, high: Array, count: int, rng: np.random.Generator) -> Array:
    size = high - low
    areas = np.repeat(np.prod(size) / size, 2)  # of the two walls across each axis
    side = rng.choice(6, size=count, p=areas / areas.sum())
    points = rng.uniform(low, high, size=(count, 3))
    axis, far = side // 2, side % 2
    relief = rng.uniform(0.0, _RELIEF, size=count)
    points[np.arange(count), axis] = np.where(far, high[axis] - relief, low[axis] + relief)
    return points


def _boxes(
    low: Array, high: Array, positions: Array, count: int, rng: np.random.Generator
) -> Array:
    """Return points on upright boxes that keep clear of the positions."""
    path = positions[:: max(1, len(positions) // 500)]
    centres = rng.uniform(low, high, size=(20 * _BOXES, 3))
    distances = np.linalg.norm(centres[:, None] - path[None], axis=2).min(axis=1)
    centres = centres[distances > _CLEARANCE + 0.5 * _BOX_SIZE[1] * np.sqrt(3.0)][:_BOXES]
    if len(centres) == 0:
        return np.zeros((0, 3))
    half = 0.5 * rng.uniform(*_BOX_SIZE, size=(len(centres), 3))
    box = rng.integers(len(centres), size=count)
    offsets = rng.uniform(-half[box], half[box])
    axis = rng.integers(3, size=count)
    rows = np.arange(count)
    offsets[rows, axis] = np.copysign(half[box, axis], offsets[rows, axis])
    return np.asarray(centres[box] + offsets)
