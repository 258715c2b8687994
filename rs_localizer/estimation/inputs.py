"""The arrays of one frame, checked."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Reason
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.types import Failure

# Pixels may lie outside the image by this part of it: noise, and features at its border.
_MARGIN = 0.05
# Points that lie closer together than this (px) show no perspective.
_LEAST_EXTENT = 5.0


def checked(
    points: ArrayLike, pixels: ArrayLike, scores: ArrayLike | None
) -> tuple[Array, Array, Array | None]:
    """Points (n,3), pixels (n,2) and scores (n,) as contiguous float64 arrays.

    Raises:
        ValueError: wrong shapes, or values that are not finite.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    pixels = np.ascontiguousarray(pixels, dtype=np.float64)
    if points.size == 0 and pixels.size == 0:  # empty lists have no second dimension
        points, pixels = points.reshape(0, 3), pixels.reshape(0, 2)
    n = len(points)
    if points.shape != (n, 3) or pixels.shape != (n, 2):
        raise ValueError(
            f"points must be (n,3) and pixels (n,2), got {points.shape} and {pixels.shape}"
        )
    checks = [("points", points), ("pixels", pixels)]
    if scores is not None:
        scores = np.ascontiguousarray(scores, dtype=np.float64)
        if scores.shape != (n,):
            raise ValueError(f"scores must be ({n},), got {scores.shape}")
        checks.append(("scores", scores))
    for name, array in checks:
        if not np.all(np.isfinite(array)):
            raise ValueError(f"{name} must be finite, found NaN or infinity")
    return points, pixels, scores


def distinct(points: Array, pixels: Array, chosen: IntArray) -> IntArray:
    """The chosen correspondences without those that repeat another one: a copy says nothing new."""
    # Equal pixels have equal keys; nearly always there are none, and one sort says so.
    keys = np.sort(pixels[chosen, 0] + math.pi * pixels[chosen, 1])
    if np.all(keys[1:] != keys[:-1]):
        return chosen
    pairs = np.hstack([points[chosen], pixels[chosen]])
    first = np.unique(pairs, axis=0, return_index=True)[1]
    return chosen[np.sort(first)]


@kernel
def near_image(pixels: Array, width: float, height: float) -> BoolArray:
    """Which pixels (n,2) lie in the image, or as far outside as noise may have put them."""
    near = np.empty(len(pixels), dtype=np.bool_)
    across, down = _MARGIN * width, _MARGIN * height
    for i in range(len(pixels)):
        x, y = pixels[i, 0], pixels[i, 1]
        near[i] = -across < x < width + across and -down < y < height + down
    return near


@kernel
def _extent(pixels: Array, chosen: IntArray) -> float:
    """Width or height of what the chosen pixels fill, whichever is the larger."""
    largest = 0.0
    for axis in range(2):
        low, high = np.inf, -np.inf
        for i in chosen:
            low, high = min(low, pixels[i, axis]), max(high, pixels[i, axis])
        largest = max(largest, high - low)
    return largest


def unfit(
    camera: Camera, pixels: Array, usable: IntArray, shown: BoolArray, needed: int
) -> Failure | None:
    """Why points cannot carry a pose whatever the motion, or None.

    Args:
        pixels: (n,2) of all points.
        usable: indices of those that can be used.
        shown: (n,) which lie in the image.
        needed: fewest points of a pose.
    """
    if len(usable) < needed:
        outside = int(np.count_nonzero(~shown))
        width, height = camera.size
        hint = f"; {outside} lie outside the image of {width} x {height} pixels" if outside else ""
        return Failure(
            Reason.TOO_FEW_POINTS,
            f"{len(usable)} usable points of {len(pixels)}, {needed} are needed{hint}",
        )
    extent = _extent(pixels, usable)
    if extent < _LEAST_EXTENT:
        return Failure(
            Reason.DEGENERATE,
            f"all {len(usable)} points lie within {extent:.2g} pixels; are these normalized "
            "coordinates? Pixels of the raw image are needed",
        )
    return None
