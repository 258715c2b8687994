"""Images -> keypoints with descriptors: good ones, and some of every part of the image.

A pose is as certain as the points are spread; the best keypoints alone lie where most texture is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.features.methods import METHODS, Descriptors, FeatureError, Gray

# Keypoints that a cell of the grid holds on average.
_PER_CELL = 8


def balanced(pixels: Array, scores: Array, size: tuple[int, int], most: int) -> IntArray:
    """Rows (k,) of at most so many keypoints: of each cell of a grid the best, then the second ...

    Args:
        pixels: (n,2)
        scores: (n,) higher is better.
        size: width and height of the image.
        most: how many to keep.
    """
    count = len(pixels)
    if count <= most:
        return np.arange(count)
    side = np.sqrt(size[0] * size[1] * _PER_CELL / most)
    columns, rows = (pixels // side).astype(np.int64).T
    cells = rows * (int(size[0] // side) + 1) + columns
    order = np.lexsort((-scores, cells))
    ranks = np.arange(count) - np.searchsorted(cells[order], cells[order])
    return np.sort(order[np.lexsort((-scores[order], ranks))[:most]])


# OpenCV's detectors fail on smaller images (px), in which there is nothing to find.
_LEAST_SIDE = 16
# Larger ones (px) are reduced, as COLMAP does: SIFT takes 250 bytes a pixel.
_LONGEST_SIDE = 3200


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """The keypoints of an image, as a cloud holds them (float32)."""

    pixels: Array  # (n,2) raw pixels, the centre of the first one at 0, 0 (COLMAP: 0.5, 0.5)
    scores: Array  # (n,) higher is better
    sizes: Array  # (n,) px, diameter of what is described
    descriptors: Descriptors  # (n,d) SIFT: numbers; ORB and AKAZE: bits

    def __len__(self) -> int:
        return len(self.pixels)


class FeatureExtractor:
    """Finds keypoints; the same image gives the same bits.

    Args:
        kind: ``sift``, ``orb`` or ``akaze``.
        most: keypoints of an image.

    Raises:
        FeatureError: for another kind, or one that this OpenCV does not have.
    """

    def __init__(self, kind: str, most: int) -> None:
        if kind not in METHODS:
            raise FeatureError(f"features must be one of {', '.join(METHODS)}; got {kind!r}")
        self._method = METHODS[kind]
        self._most = most
        self._detector = self._method.create(most)

    def extract(self, image: Gray) -> Features:
        """The keypoints of an image (h,w)."""
        height, width = image.shape
        if max(height, width) <= _LONGEST_SIDE:
            return self._extract(image)
        ratio = _LONGEST_SIDE / max(height, width)
        size = max(1, round(width * ratio)), max(1, round(height * ratio))
        reduced = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        features = self._extract(reduced)
        scale = np.array([width / size[0], height / size[1]])
        return replace(
            features,
            pixels=_single((features.pixels + 0.5) * scale - 0.5),
            sizes=_single(features.sizes / ratio),
        )

    def _extract(self, image: Gray) -> Features:
        detected: Sequence[Any] = ()
        descriptors = None
        if min(image.shape) >= _LEAST_SIDE:
            if self._method.at_once:
                detected, descriptors = self._detector.detectAndCompute(image, None)
                rows = self._choose(detected, image)
                detected = [detected[row] for row in rows]
                descriptors = None if descriptors is None else descriptors[rows]
            else:
                detected = self._detector.detect(image)
                chosen = [detected[row] for row in self._choose(detected, image)]
                # Some are too near the rim, and others change their places.
                detected, descriptors = self._detector.compute(image, chosen)
        if descriptors is None:
            detected, descriptors = (), np.zeros((0, self._detector.descriptorSize()))
        return Features(
            _single(self._method.place(image, detected)),
            _single(np.array([keypoint.response for keypoint in detected])),
            _single(np.array([keypoint.size for keypoint in detected])),
            self._method.pack(descriptors),
        )

    def _choose(self, detected: Sequence[Any], image: Gray) -> list[int]:
        pixels = np.array([keypoint.pt for keypoint in detected]).reshape(-1, 2)
        scores = np.array([keypoint.response for keypoint in detected])
        height, width = image.shape
        rows: list[int] = balanced(pixels, scores, (width, height), self._most).tolist()
        return rows


def _single(values: Array) -> Array:
    """What is left of numbers in single precision."""
    return values.astype(np.float32).astype(np.float64)


# Blue, green, red.
_COLOR = (0, 230, 255)
_LEAST_RADIUS = 2
# Digits after the point of drawn coordinates, in bits.
_SHIFT = 4


def draw_features(image: NDArray[np.uint8], features: Features) -> NDArray[np.uint8]:
    """The image (h,w,3) with a circle around what each descriptor describes."""
    picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    middles = np.rint(features.pixels * 2**_SHIFT).astype(int).tolist()
    radii = np.maximum(features.sizes / 2, _LEAST_RADIUS) * 2**_SHIFT
    for middle, radius in zip(middles, np.rint(radii).astype(int).tolist(), strict=True):
        cv2.circle(picture, middle, radius, _COLOR, 1, cv2.LINE_AA, _SHIFT)
    return picture
