"""Centres of grids of circles in images, by OpenCV's own detector."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.markers.chessboards import ordered
from rs_localizer.markers.dictionaries import Gray
from rs_localizer.markers.prints import CircleGrid

# Circles between this many pixels and this share of the image are looked for: OpenCV's own upper
# limit of 5000 px is soon passed by a board that fills the image of a large sensor.
_LEAST_AREA, _LARGEST_SHARE = 12.0, 0.02


def find_circles(image: Gray, grid: CircleGrid, previous: Array | None = None) -> Array | None:
    """Pixels (n,2) of the centres of a grid in the order of ``grid.points``.

    A symmetric one looks the same turned by half (a square one by a quarter, too): then the order
    is the one that is closest to the ``previous`` centres; without them, the one that reads as text
    does. Seen at an angle, the middle of a circle's image is not quite that of the circle: the
    larger the circles and the nearer the board, the farther off.

    Returns:
        None when the whole grid is not seen.
    """
    if grid.inverted:
        image = np.asarray(cv2.bitwise_not(image), np.uint8)
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if grid.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    found, centres = cv2.findCirclesGrid(
        image, (grid.columns, grid.rows), flags=kind, blobDetector=_blobs(image)
    )
    if not found:
        return None
    pixels = np.asarray(centres, np.float64).reshape(-1, 2)
    if grid.asymmetric:
        return pixels
    return ordered(pixels.reshape(grid.rows, grid.columns, 2), previous)


def _blobs(image: Gray) -> Any:
    opencv: Any = cv2  # whose type stubs lack these
    wanted = opencv.SimpleBlobDetector_Params()
    wanted.minArea, wanted.maxArea = _LEAST_AREA, max(5000.0, _LARGEST_SHARE * image.size)
    return opencv.SimpleBlobDetector_create(wanted)
