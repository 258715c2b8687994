# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of cameras that move while their rows are exposed, by the independent projector."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from benchmarks.aided import believed
from benchmarks.independent.cameras import Camera

Pose = Callable[[np.ndarray], tuple[Rotation, np.ndarray]]
"""Rotations and places (n,3), map_from_camera, at times (n,) s from the middle row."""


def camera_of(true: Camera, **changes: Any) -> rsl.Camera:
    """The camera as it is calibrated, or as these changes have it."""
    return replace(believed(true), **changes)


def shown(true: Camera, pose: Pose, points: np.ndarray) -> np.ndarray:
    """Pixels (n,2) of points (n,3), each at the time of its own row; NaN where there is none."""

    def local_at(delay: np.ndarray) -> np.ndarray:
        rotation, place = pose(delay - 0.5 * true.readout_time)
        return rotation.inv().apply(points - place)

    return true.project_rolling(local_at, (len(points),))


def inside(true: Camera, pixels: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Which (n,) of pixels (n,2) lie in the image."""
    last = np.array([true.width, true.height]) - 1.0
    return ((pixels >= margin) & (pixels <= last - margin)).all(axis=1)
