"""A first lens from images in which the camera hardly moves (Zhang 2000, by OpenCV)."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.trajectory.observe import Observed

_MOST_IMAGES, _LEAST_IMAGES = 30, 4
# Of the points that the fullest image shows.
_LEAST_SHARE = 0.6
# Focal lengths by image width to begin with, before scenes that are no plane.
_FOCAL_LENGTHS = (0.7, 1.0, 1.4)
_LEAST_POINTS = 8
_FLAT = 1e-6  # thickness of a plane by its size


def first_lens(size: tuple[int, int], images: list[Observed]) -> Camera:
    """A pinhole camera with radial and tangential distortion.

    Args:
        size: width and height, pixels.
        images: in the order of their stamps.

    Raises:
        ValueError: when too few images show enough of the map, or show it from one side only.
    """
    chosen = _slow(images)
    if len(chosen) < _LEAST_IMAGES:
        raise ValueError(
            f"{len(chosen)} images show enough of the map for a first calibration, at least "
            f"{_LEAST_IMAGES} are needed; give --calibration"
        )
    points = [np.asarray(image.points, np.float32) for image in chosen]
    pixels = [np.asarray(image.pixels, np.float32) for image in chosen]
    best: tuple[float, Any, Any] | None = None
    for K, flags in _starts(size, np.concatenate([image.points for image in chosen])):
        try:
            error, found, D, _, _ = cv2.calibrateCamera(
                points, pixels, size, K, np.zeros(5), flags=flags | cv2.CALIB_FIX_K3
            )
        except cv2.error:
            continue
        if np.isfinite(error) and (best is None or error < best[0]):
            best = (error, found, D.ravel()[:5])
    if best is None:
        raise ValueError("no lens fits the images; show the board from several sides")
    return Camera(width=size[0], height=size[1], K=best[1], D=best[2])


def _slow(images: list[Observed]) -> list[Observed]:
    """Images that show much of the map and in which it hardly moves, from all of the recording."""
    fullest = max((len(image.points) for image in images), default=0)
    least = max(_LEAST_SHARE * fullest, _LEAST_POINTS)
    full = [image for image in images if len(image.points) >= least]
    speeds = [_speed(a, b) for a, b in pairwise(full)]
    if not speeds:
        return full
    slower = [min(pair) for pair in zip([speeds[0], *speeds], [*speeds, speeds[-1]], strict=True)]
    # The slowest of each part of the recording.
    parts = np.array_split(np.arange(len(full)), min(_MOST_IMAGES, len(full)))
    return [full[min(part, key=lambda k: slower[k])] for part in parts]


def _speed(before: Observed, after: Observed) -> float:
    """px per s, of what both images show."""
    common = (before.points[:, None] == after.points[None]).all(axis=2)
    first, second = np.nonzero(common)
    if len(first) == 0:
        return np.inf
    way = np.linalg.norm(before.pixels[first] - after.pixels[second], axis=1)
    return float(np.median(way)) / max((after.stamp_ns - before.stamp_ns) * 1e-9, 1e-9)


def _starts(size: tuple[int, int], everything: Array) -> list[tuple[Array, int]]:
    spread = np.linalg.svd(everything - everything.mean(axis=0), compute_uv=False)
    centre = 0.5 * (np.array(size) - 1.0)
    starts = []
    for share in _FOCAL_LENGTHS:
        K = np.array([[0.0, 0.0, centre[0]], [0.0, 0.0, centre[1]], [0.0, 0.0, 1.0]])
        K[0, 0] = K[1, 1] = share * size[0]
        starts.append((K, cv2.CALIB_USE_INTRINSIC_GUESS))
    if spread[2] < _FLAT * spread[0] and np.ptp(everything[:, 2]) < _FLAT * spread[0]:
        starts.append((starts[0][0].copy(), 0))  # OpenCV finds its own before z = 0
    return starts
