# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The debug pictures of the detectors: what was found, and which of it the localizer has kept."""

from collections import deque
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.io.clouds import EmptyCloudError, read_correspondences
from rs_localizer.io.images import Image
from rs_localizer.io.messages import MessageError, stamp_ns

Result = TypeVar("Result")
Picture = NDArray[np.uint8]  # (h,w,3) blue, green, red
Drawn = tuple[Image, Picture, Array]
"""An image, its picture, and the pixels (n,2) of the points that went to the localizer."""

# Images that wait for their inliers; the oldest is then shown as it is.
_WAITING = 3
# After so many images without an answer nobody localizes, and none waits.
_PATIENCE = 10
# Kept points are green dots, others red crosses: they differ by shape, too.
_KEPT, _REFUSED = (60, 220, 60), (60, 60, 255)
_SIZE = 4  # px


class DebugPictures(Generic[Result]):
    """Holds images until their inliers come; lives in the worker's thread.

    Args:
        draw: makes the picture of what was found.
        show: takes the finished picture of an image.
    """

    def __init__(
        self, draw: Callable[[Result], Drawn], show: Callable[[Image, Picture], None]
    ) -> None:
        self._draw, self._show = draw, show
        self._waiting: deque[Result] = deque()
        self._unanswered = _PATIENCE

    def add(self, result: Result) -> None:
        """Take an image; the oldest that still waits is shown as it is."""
        self._waiting.append(result)
        self._unanswered += 1
        while len(self._waiting) > (_WAITING if self._unanswered <= _PATIENCE else 0):
            image, picture, _ = self._draw(self._waiting.popleft())
            self._show(image, picture)

    def take_inliers(self, message: Any) -> None:
        """A sensor_msgs/PointCloud2 of the localizer: show the image that it belongs to."""
        self._unanswered = 0
        try:
            kept = read_correspondences(message).pixels
        except (MessageError, EmptyCloudError):
            return
        stamp = stamp_ns(message)
        while self._waiting:
            image, picture, pixels = self._draw(self._waiting[0])
            if image.stamp_ns > stamp:
                return
            self._waiting.popleft()
            if image.stamp_ns == stamp:
                draw_kept(picture, pixels, kept)
            self._show(image, picture)


def draw_kept(picture: Picture, pixels: Array, kept: Array) -> None:
    """Add green dots where points were kept, and red crosses where they were not."""
    inliers = {(round(u, 1), round(v, 1)) for u, v in kept.tolist()}
    for u, v in pixels.tolist():
        place = round(u), round(v)
        if (round(u, 1), round(v, 1)) in inliers:
            cv2.circle(picture, place, _SIZE, _KEPT, -1, cv2.LINE_AA)
        else:
            cv2.drawMarker(picture, place, _REFUSED, cv2.MARKER_TILTED_CROSS, 2 * _SIZE, 2)
