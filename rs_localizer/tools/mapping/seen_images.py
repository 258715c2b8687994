# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The images that a map is made from, as far as they are kept without their pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from rs_localizer.config import FeatureKind
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.features.extraction import FeatureExtractor, Features
from rs_localizer.io.images import Gray, Image
from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.offline.detect import ImageTally, usable
from rs_localizer.offline.image_sources import Carried, Shot
from rs_localizer.tools.mapping import MappingError
from rs_localizer.tools.mapping.structure import image_name

# JPEG's quality of what COLMAP gets: at this one, errors are below a grey level.
_QUALITY = 97
# A view with fewer features is blurred, dark, or of a blank wall.
_FEW_FEATURES = 50
LEAST_VIEWS = 3
# COLMAP gets all views of a short recording and this many a second of a long one: at a turn of 60
# degrees a second, neighbours have three quarters of a picture of 60 degrees in common.
_KEYFRAMES, _KEYFRAMES_PER_SECOND = 60, 4.0
# After this many images without features the rest is refused: two seconds of a usual video.
_EARLY_VIEWS = 30
# Images a hair before their time are in time.
_EARLY = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class SeenImage:
    """Features and markers of an image."""

    stamp_ns: int
    image: Path  # its picture, by colmap.image_name
    features: Features
    sharpness: float  # the higher the sharper; comparable between views of the same scene
    corners: Array  # (m,2) raw, of the markers
    corner_ids: IntArray  # (m,) rows of the marker map's points


def sharpness(image: Gray) -> float:
    """Return the fine detail of a picture: grey levels (rms) of the Laplacian."""
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

    def detect_in(self, image: Image) -> SeenImage:
        """Return the view of an image."""
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
        return SeenImage(image.stamp_ns, path, features, sharpness(image.pixels), corners, ids)


@dataclass(slots=True)
class Looked(ImageTally):
    """Views of a recording."""

    views: list[SeenImage] = field(default_factory=list)
    camera: Camera | None = None  # without its readout time; None: nobody has calibrated it
    moments: dict[float, int] = field(default_factory=dict)  # asked for, s -> row of its view


def look_through(
    shots: Iterable[Shot | Carried], looker: Looker, rate: float, moments: Sequence[float],
    done: Callable[[], object],
) -> Looked:  # fmt: skip
    """Look at the images that are kept: this many a second, and the first ones at or after moments.

    Args:
        moments: s after the first image.
        done: called after each image.

    Raises:
        ValueError: for a camera that changes, or images without features.
    """
    found = Looked()
    for _, image, camera in usable(shots, ScanDirection.TOP_TO_BOTTOM, found, done):
        if found.views and camera is not found.camera:
            raise ValueError("the camera changes within the recording; cut it there")
        found.camera = camera
        since = (image.stamp_ns - found.stamps_ns[0]) * 1e-9
        asked = [s for s in moments if s not in found.moments and since >= s - 1e-3]
        found.moments |= dict.fromkeys(asked, len(found.views))
        due_ns = 1e9 * _EARLY / rate
        if asked or not found.views or image.stamp_ns - found.views[-1].stamp_ns >= due_ns:
            found.views.append(looker.detect_in(image))
            if len(found.views) == _EARLY_VIEWS:
                check_features(found.views)
    return found


def check_views(views: Sequence[SeenImage]) -> None:
    """Refuse, before minutes of work, views that will make no map.

    Raises:
        MappingError: saying what was found.
    """
    if len(views) < LEAST_VIEWS:
        raise MappingError(f"{len(views)} images make no map; at least {LEAST_VIEWS} are needed")
    check_features(views)


def check_features(views: Sequence[SeenImage]) -> None:
    """Refuse views that show too little.

    Raises:
        MappingError: saying what was found.
    """
    features = float(np.median([len(view.features) for view in views]))
    if features < _FEW_FEATURES:
        raise MappingError(
            f"the images show {features:.0f} features each (median), at least {_FEW_FEATURES} are "
            "needed: are they blurred, dark, or of blank walls?"
        )


def choose_keyframes(views: Sequence[SeenImage]) -> IntArray:
    """Return rows (k,) of views for COLMAP: evenly spaced, the sharpest of each few."""
    seconds = 1e-9 * (views[-1].stamp_ns - views[0].stamp_ns)
    count = max(_KEYFRAMES, math.ceil(_KEYFRAMES_PER_SECOND * seconds))
    slots = np.array_split(np.arange(len(views)), min(count, len(views)))
    return np.array([max(slot, key=lambda row: views[row].sharpness) for slot in slots], np.int64)
