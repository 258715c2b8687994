"""The arrays of one frame, checked."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Reason
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


def median_point(points: Array, chosen: BoolArray) -> Array:
    """Median (3,) of each coordinate over some of the points (n,3); zero if there are none."""
    of = points[chosen]
    if len(of) == 0:
        return np.zeros(3)
    middle = len(of) // 2
    median: Array = np.partition(of, middle, axis=0)[middle]  # np.median takes three times as long
    return median


def distinct(points: Array, pixels: Array, chosen: IntArray) -> IntArray:
    """The chosen correspondences without those that repeat another one: a copy says nothing new."""
    # Equal pixels have equal keys; nearly always there are none, and one sort says so.
    keys = np.sort(pixels[chosen, 0] + math.pi * pixels[chosen, 1])
    if np.all(keys[1:] != keys[:-1]):
        return chosen
    pairs = np.hstack([points[chosen], pixels[chosen]])
    first = np.unique(pairs, axis=0, return_index=True)[1]
    return chosen[np.sort(first)]


def near_image(camera: Camera, pixels: Array) -> BoolArray:
    """Which pixels (n,2) lie in the image, or as far outside as noise may have put them."""
    size = np.array(camera.size)
    margin = _MARGIN * size
    inside = (pixels > -margin) & (pixels < size + margin)
    near: BoolArray = inside[:, 0] & inside[:, 1]  # along a short axis NumPy takes its time
    return near


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
    extent = float(np.ptp(pixels[usable], axis=0).max())
    if extent < _LEAST_EXTENT:
        return Failure(
            Reason.DEGENERATE,
            f"all {len(usable)} points lie within {extent:.2g} pixels; are these normalized "
            "coordinates? Pixels of the raw image are needed",
        )
    return None
