"""Corners of FAST between the pixels.

FAST (and so ORB) gives whole pixels of a level of the pyramid, often beside the corner. Here the
smaller eigenvalue of the gradients' second moments (Shi, Tomasi, CVPR 1994) says where within a
pixel the corner is, and a parabola through its largest value where between them.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array, IntArray

# A corner is looked for within so many pixels of FAST's, gradients are summed over as many.
_REACH = _WINDOW = 1
# Around a corner: its reach, a neighbour for the parabola, the window, a neighbour for gradients.
_MARGIN = _REACH + 1 + _WINDOW + 1


def refined(image: NDArray[np.uint8], corners: IntArray, levels: IntArray, step: float) -> Array:
    """Corners (n,2) in pixels of the image, the centre of the first one at 0, 0.

    Args:
        image: (h,w)
        corners: (n,2) x, y, whole pixels of their level.
        levels: (n,) of the pyramid.
        step: how much smaller each level is than the one before.
    """
    result = np.empty(corners.shape)
    height, width = image.shape
    reduced = image
    for level in range(int(levels.max(initial=-1)) + 1):
        if level:
            # As ORB does, so that corners are where it saw them.
            size = tuple(max(1, round(length / step**level)) for length in (width, height))
            reduced = np.asarray(
                cv2.resize(reduced, size, interpolation=cv2.INTER_LINEAR_EXACT), np.uint8
            )
        rows = np.flatnonzero(levels == level)
        scale = np.array([width / reduced.shape[1], height / reduced.shape[0]])
        found = corners[rows] + _offsets(reduced, corners[rows])
        # Pixels are squares: the centre of the first one of a level is not that of the image's.
        result[rows] = (found + 0.5) * scale - 0.5
    return result


def _offsets(image: NDArray[np.uint8], corners: IntArray) -> Array:
    """From whole pixels (n,2) of an image to the corners beside them (n,2)."""
    around = np.arange(-_MARGIN, _MARGIN + 1)
    padded = np.pad(image, _MARGIN, mode="edge")
    columns, rows = corners[:, :1] + _MARGIN + around, corners[:, 1:] + _MARGIN + around
    strength = _strength(padded[rows[:, :, None], columns[:, None, :]].astype(np.float64))
    count, side = len(corners), 2 * _REACH + 1
    best = strength[:, 1:-1, 1:-1].reshape(count, side * side).argmax(axis=1)
    y, x = best // side + 1, best % side + 1
    n, peak = np.arange(count), strength[np.arange(count), y, x]
    across = _vertex(strength[n, y, x - 1], peak, strength[n, y, x + 1])
    along = _vertex(strength[n, y - 1, x], peak, strength[n, y + 1, x])
    return np.column_stack([x + across, y + along]) - (_REACH + 1)


def _strength(patches: Array) -> Array:
    """The smaller eigenvalue of the second moments (n,s,s) in patches (n,s+4,s+4)."""
    dx = _smooth(patches[:, :, 2:] - patches[:, :, :-2], 1)
    dy = _smooth(patches[:, 2:] - patches[:, :-2], 2)
    xx, yy, xy = _window(dx * dx), _window(dy * dy), _window(dx * dy)
    smaller: Array = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    return smaller


def _smooth(values: Array, axis: int) -> Array:
    """By 1, 2, 1 along an axis, for Sobel's gradients."""
    first = np.moveaxis(values, axis, 0)
    smooth: Array = np.moveaxis(first[:-2] + 2.0 * first[1:-1] + first[2:], 0, axis)
    return smooth


def _window(values: Array) -> Array:
    """Sums over windows."""
    side = 2 * _WINDOW + 1
    windows = np.lib.stride_tricks.sliding_window_view(values, (side, side), (1, 2))
    sums: Array = windows.sum(axis=(3, 4))
    return sums


def _vertex(before: Array, peak: Array, after: Array) -> Array:
    """Where (n,) the parabola through three values has its vertex, at most a pixel away."""
    bend = before - 2.0 * peak + after
    apart = 0.5 * (before - after)
    vertex: Array = np.divide(apart, bend, np.zeros_like(bend), where=bend < 0.0)
    return np.clip(vertex, -1.0, 1.0)
