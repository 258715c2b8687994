# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images as the mapping needs them: what is kept of each one when its pixels have been let go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from rs_localizer.config import FeatureKind
from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.features.extraction import FeatureExtractor, Features
from rs_localizer.io.images import Gray, Image
from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.tools.mapping.colmap import image_name

# JPEG's quality of what COLMAP gets: at this one, errors are below a grey level.
_QUALITY = 97
# A view this much less sharp than those around it (so many each way) is blurred.
_BLURRED, _AROUND = 0.6, 15


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What an image shows."""

    stamp_ns: int
    image: Path  # its picture, by colmap.image_name
    features: Features
    sharpness: float  # the higher the sharper; comparable between views of the same scene
    corners: Array  # (m,2) raw, of the markers
    corner_ids: IntArray  # (m,) rows of the marker map's points


def sharpness(image: Gray) -> float:
    """How much of the picture is fine detail: grey levels (rms) of the Laplacian."""
    return float(cv2.Laplacian(image, cv2.CV_32F, ksize=3).std())


class Looker:
    """Looks at the images of a recording, in their order, and writes them down for COLMAP.

    Args:
        most: features of an image.
        images: folder to write to.
        marker_map: markers to look for, too.
    """

    def __init__(self, most: int, images: Path, marker_map: MarkerMap | None = None) -> None:
        self._extractor = FeatureExtractor(FeatureKind.SIFT, most)
        self._images, self._count = images, 0
        self._detector = None if marker_map is None else MarkerDetector(marker_map)

    def look(self, image: Image) -> View:
        """What is needed of an image."""
        path = self._images / image_name(self._count)
        self._count += 1
        quality = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
        # Not cv2.imwrite, which says nothing of a full disk.
        path.write_bytes(cv2.imencode(".jpg", image.pixels, quality)[1].tobytes())
        corners, ids = np.zeros((0, 2)), np.zeros(0, np.int64)
        if self._detector is not None:
            detections = self._detector.detect(image.pixels, image.stamp_ns)
            corners, ids = detections.pixels, detections.ids
        features = self._extractor.extract(image.pixels)
        return View(image.stamp_ns, path, features, sharpness(image.pixels), corners, ids)


def blurred(views: Sequence[View]) -> BoolArray:
    """Which views (n,) are much less sharp than those around them."""
    values = np.array([view.sharpness for view in views])
    rows = np.arange(len(values))
    usual = [np.median(values[max(0, row - _AROUND) : row + _AROUND + 1]) for row in rows]
    return np.asarray(values < _BLURRED * np.array(usual))
