# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Whole images as a global shutter would have taken them, from the poses of two rows."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion, project_rolling

Depths = Callable[[Array, Array, Array], Array]
"""Depths z (n,) m, by rotation (3,3) and translation (3,) camera_from_map and rays ``x, y, 1``
(n,3) of a camera; NaN: not known.
"""

# Between points so far apart (px) the displacement of pixels is interpolated: it is as smooth as
# the lens and the depth.
_STEP = 8
# A map whose points lie farther from a plane than this share of their extent has none.
_FLAT = 0.02


class FlatError(ValueError):
    """Points without a plane; the message says how far they are from one."""


def motion_between(first: tuple[Array, Array], last: tuple[Array, Array]) -> Motion:
    """The motion at constant velocities between the first and the last row.

    Args:
        first, last: rotation (3,3) map_from_camera and position (3,) m of the camera.
    """
    turn = so3.log(np.ascontiguousarray(first[0].T @ last[0]))
    middle = first[0] @ so3.exp(0.5 * turn)  # map_from_camera
    position = 0.5 * (first[1] + last[1])
    velocity = middle.T @ (last[1] - first[1])
    return Motion(middle.T, -middle.T @ position, turn, velocity)


def plane_depths(points: Array) -> Depths:
    """Depths of the plane through points (n,3) of the map.

    Raises:
        FlatError: when they lie in none.
    """
    middle = points.mean(axis=0)
    _, extents, axes = np.linalg.svd(points - middle, full_matrices=False)
    if len(points) < 3 or extents[2] > _FLAT * extents[1]:
        share = extents[2] / extents[1] if len(points) > 2 else 1.0
        raise FlatError(
            f"the points of the map lie in no plane: {share:.0%} of their extent off it"
        )
    normal = axes[2]

    def depths(rotation: Array, translation: Array, rays: Array) -> Array:
        # R X + t = z ray, normal X = normal middle
        ahead = rays @ (rotation @ normal)
        distance = normal @ middle + (rotation @ normal) @ translation
        with np.errstate(divide="ignore"):
            z: Array = distance / ahead
        return np.where((z > 0.0) & np.isfinite(z), z, np.nan)

    return depths


def map_depths(points: Array) -> Depths:
    """Depths between the points (n,3) of a map before the camera: who hides whom is not known.

    Their inverses are interpolated in the image; around them are those of the nearest.
    """
    from scipy.interpolate import griddata  # 20 MB, which a node without this output does not need

    def depths(rotation: Array, translation: Array, rays: Array) -> Array:
        in_camera = points @ rotation.T + translation
        in_camera = in_camera[in_camera[:, 2] > 0.0]
        places, inverse = in_camera[:, :2] / in_camera[:, 2:], 1.0 / in_camera[:, 2]
        near = np.abs(places).max(axis=1) < 2.0 * np.abs(rays[:, :2]).max()
        if np.count_nonzero(near) < 4:
            return np.full(len(rays), np.nan)
        given = places[near], inverse[near], rays[:, :2]
        interpolated = griddata(*given, method="linear")
        return np.asarray(
            1.0
            / np.where(np.isfinite(interpolated), interpolated, griddata(*given, method="nearest"))
        )

    return depths


def rectified(
    camera: Camera,
    image: NDArray[np.uint8],
    motion: Motion,
    depths: Depths | None = None,
    tau: float = 0.0,
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The image that a global shutter would have taken.

    Args:
        camera: that took it, with its shutter.
        image: (h,w) or (h,w,3).
        motion: during the readout.
        depths: of what it shows; None: far away, so that only the rotation counts.
        tau: row time of the global shutter: 0 the middle row, -0.5 the first, 0.5 the last.

    Returns:
        the image, and (h,w) which pixels are known: the others are 0.
    """
    from scipy.ndimage import map_coordinates

    height, width = image.shape[:2]
    columns, rows = (np.unique([*range(0, size, _STEP), size - 1]) for size in (width, height))
    grid = np.stack(np.meshgrid(columns, rows), axis=2).reshape(-1, 2).astype(float)
    rays = np.column_stack([camera.rays(grid), np.ones(len(grid))])
    poses_at: Callable[[Array], tuple[Array, Array]] = motion.at_rows
    rotation, translation = motion.at(tau)
    if depths is None:
        points = rays @ rotation

        def poses_at(tau: Array) -> tuple[Array, Array]:
            return motion.at_rows(tau)[0], np.zeros((len(tau), 3))

    else:
        away = depths(rotation, translation, rays)[:, None]
        points = (rays * away - translation) @ rotation
    pixels, _ = project_rolling(camera, poses_at, points)
    moved = (pixels - grid).reshape(len(rows), len(columns), 2)
    places = np.meshgrid(
        np.interp(np.arange(height), rows, np.arange(len(rows))),
        np.interp(np.arange(width), columns, np.arange(len(columns))),
        indexing="ij",
    )
    x, y = (map_coordinates(moved[:, :, k], places, order=1) for k in range(2))
    x, y = x + np.arange(width), y + np.arange(height)[:, None]
    known = (x >= 0.0) & (x <= width - 1.0) & (y >= 0.0) & (y <= height - 1.0)  # NaN is not
    across, down = (np.where(known, part, -1e6).astype(np.float32) for part in (x, y))
    made: Any = cv2.remap(image, across, down, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    made[~known] = 0
    return made, known
