"""Images as the mapping needs them: what is left of each one when its pixels have been let go."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rs_localizer.config import FeatureKind
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.features.extraction import FeatureExtractor, Features
from rs_localizer.io.images import Gray, Image
from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.maps import MarkerMap

# Corners that are followed from image to image, their least distance (px) and quality; an image
# this wide (px) shows enough of them.
_CORNERS, _DISTANCE, _QUALITY = 200, 12, 0.01
_WIDTH = 320
# Followed forth and back, a corner comes back to itself within this (px).
_ROUND_TRIP = 1.0
# Fewer corners than this determine no motion.
_LEAST_CORNERS = 12


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What an image shows, and how it follows from the one before."""

    stamp_ns: int
    features: Features
    sharpness: float  # the higher the sharper; comparable between views of the same scene
    motion: Array  # (3,3) pixels here from those of the view before; NaN: nothing was followed
    corners: Array  # (m,2) raw, of the markers
    corner_ids: IntArray  # (m,) rows of the marker map's points


class Follower:
    """Follows corners from image to image (pyramidal Lucas-Kanade): how pictures move."""

    def __init__(self) -> None:
        self._last: Gray | None = None

    def follow(self, image: Gray) -> Array:
        """Motion (3,3) of the picture (a similarity) since the last image, in its own pixels."""
        scale = min(1.0, _WIDTH / image.shape[1])
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        before, self._last = self._last, np.asarray(small, np.uint8)
        if before is None:
            return np.eye(3)
        found = _similarity(before, self._last)
        # A pixel's centre lies at scale (u + 1/2) - 1/2 in the small image.
        to_small = np.diag([scale, scale, 1.0])
        to_small[:2, 2] = 0.5 * scale - 0.5
        motion: Array = np.linalg.inv(to_small) @ found @ to_small
        return motion


def _similarity(before: Gray, after: Gray) -> Array:
    lost = np.full((3, 3), np.nan)
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, _QUALITY, _DISTANCE)
    if corners is None or len(corners) < _LEAST_CORNERS:
        return lost
    # The last argument is filled: without a flag it is no start of the search.
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.empty_like(corners))
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, there, np.empty_like(corners))
    near = np.linalg.norm(back - corners, axis=2)[:, 0] < _ROUND_TRIP
    good = near & (found[:, 0] > 0) & (returned[:, 0] > 0)
    if np.count_nonzero(good) < _LEAST_CORNERS:
        return lost
    similarity, inliers = cv2.estimateAffinePartial2D(corners[good], there[good])
    if similarity is None or np.count_nonzero(inliers) < _LEAST_CORNERS:
        return lost
    return np.vstack([similarity, [0.0, 0.0, 1.0]])


def sharpness(image: Gray) -> float:
    """How much of the picture is fine detail: grey levels (rms) of the Laplacian."""
    return float(cv2.Laplacian(image, cv2.CV_32F, ksize=3).std())


class Looker:
    """Looks at the images of a recording, in their order.

    Args:
        most: features of an image.
        marker_map: markers to look for, too.
    """

    def __init__(self, most: int, marker_map: MarkerMap | None = None) -> None:
        self._extractor = FeatureExtractor(FeatureKind.SIFT, most)
        self._follower = Follower()
        self._detector = None if marker_map is None else MarkerDetector(marker_map)

    def look(self, image: Image) -> View:
        """What is needed of an image."""
        corners, ids = np.zeros((0, 2)), np.zeros(0, np.int64)
        if self._detector is not None:
            found = self._detector.detect(image.pixels, image.stamp_ns)
            corners, ids = found.pixels, found.ids
        return View(
            image.stamp_ns,
            self._extractor.extract(image.pixels),
            sharpness(image.pixels),
            self._follower.follow(image.pixels),
            corners,
            ids,
        )
