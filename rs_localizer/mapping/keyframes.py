"""Which images of many a map is built from: sharp ones, well spaced, while the camera is slow.

A keyframe overlaps with the one before it, so that both show the same landmarks, and lies far
enough off that they are seen at an angle. Of the images in between these bounds the best one is
taken: where the picture moves slowly, neither motion blur nor the rolling shutter spoil it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray

# Share of the picture that a keyframe has in common with the one before: between these.
_MOST_OVERLAP, _LEAST_OVERLAP = 0.88, 0.72
# Sharpness below this share of that of the views around it is blur; so many are around, each way.
_BLURRED, _AROUND = 0.6, 15


@dataclass(frozen=True, slots=True, eq=False)
class Keyframes:
    """The views that were chosen."""

    chosen: IntArray  # (k,) rows of the views, increasing
    blurred: BoolArray  # (n,) views that are much less sharp than those around them
    breaks: IntArray  # rows of the views that nothing connects with the one before


def choose_keyframes(motions: Array, sharpness: Array, size: tuple[int, int]) -> Keyframes:
    """Choose keyframes from views in the order of their stamps.

    Args:
        motions: (n,3,3) of the pictures, each from the one before; NaN where none is known.
        sharpness: (n,), see :func:`rs_localizer.mapping.views.sharpness`.
        size: width and height of the images.
    """
    blurred = sharpness < _BLURRED * _running_median(sharpness)
    speeds = _speeds(motions, size)
    usual = max(float(np.median(speeds)), 1.0)
    quality = np.where(blurred, 0.0, 1.0 / (1.0 + speeds / usual))
    breaks = np.flatnonzero(~np.isfinite(motions[1:]).all(axis=(1, 2))) + 1
    starts = [0, *breaks.tolist()]
    ends = [*breaks.tolist(), len(motions)]
    chosen = [
        row
        for start, end in zip(starts, ends, strict=True)
        for row in _of_stretch(motions[start:end], quality[start:end], size, start)
    ]
    return Keyframes(np.array(chosen, np.int64), blurred, breaks)


def _of_stretch(motions: Array, quality: Array, size: tuple[int, int], start: int) -> Iterator[int]:
    """Rows of the keyframes of views that follow from each other."""
    key = 0
    yield start
    while key < len(motions):
        window = []
        since = np.eye(3)
        for row in range(key + 1, len(motions)):
            since = motions[row] @ since
            overlap = _overlap(since, size)
            if overlap < _LEAST_OVERLAP:
                break
            if overlap < _MOST_OVERLAP:
                window.append(row)
        else:
            if not window:  # the picture stays until the end
                return
        # One that moves through all of the window at once is itself the next.
        window = window or [row]
        key = max(window, key=lambda row: (quality[row], -row))
        yield start + key


def _overlap(motion: Array, size: tuple[int, int]) -> float:
    """Share of a picture that is still there after this motion of it."""
    width, height = size
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
    moved = corners @ motion[:2, :2].T + motion[:2, 2]
    rim, there = corners.astype(np.float32), moved.astype(np.float32)
    area, _ = cv2.intersectConvexConvex(there, rim)
    larger = max(abs(float(np.linalg.det(motion[:2, :2]))), 1.0)
    return float(area) / (width * height * larger)


def _speeds(motions: Array, size: tuple[int, int]) -> Array:
    """How far (n,) the middle of the picture goes around each view, px per view."""
    middle = np.array([0.5 * size[0], 0.5 * size[1], 1.0])
    steps = np.linalg.norm((motions @ middle - middle)[:, :2], axis=1)
    steps[0] = steps[1] if len(steps) > 1 else 0.0
    following = np.append(steps[1:], steps[-1])
    return np.asarray(np.nan_to_num(np.fmax(steps, following), nan=float(max(size))))


def _running_median(values: Array) -> Array:
    rows = np.arange(len(values))
    return np.array([np.median(values[max(0, row - _AROUND) : row + _AROUND + 1]) for row in rows])
