# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images -> keypoints with descriptors: good ones, and some of every part of the image.

A pose is as certain as the points are spread; the best keypoints alone lie where most texture is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.config import FeatureKind
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.io.clouds import choose_balanced
from rs_localizer.io.maps.landmarks import Map

_ORB_BYTES = 32  # of a descriptor; AKAZE's has 61
# A corner is looked for within this many pixels of FAST's, gradients are summed over a square of
# this side. A parabola through its strength needs a neighbour.
_REACH, _WINDOW = 1, 3
_MARGIN = _REACH + 1


def refine_corners(
    image: NDArray[np.uint8], corners: IntArray, levels: IntArray, step: float
) -> Array:
    """Return the corners (n,2) in pixels of the image, the centre of the first one at 0, 0.

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
            # The sizes are ORB's, so that corners are where ORB places them.
            size = tuple(max(1, round(length / step**level)) for length in (width, height))
            reduced = np.asarray(
                cv2.resize(reduced, size, interpolation=cv2.INTER_LINEAR_EXACT), np.uint8
            )
        rows = np.flatnonzero(levels == level)
        scale = np.array([width / reduced.shape[1], height / reduced.shape[0]])
        precise = corners[rows] + _offsets(reduced, corners[rows])
        # Pixels are squares: the centre of the first one of a level is not that of the image's.
        result[rows] = (precise + 0.5) * scale - 0.5
    return result


def _offsets(image: NDArray[np.uint8], corners: IntArray) -> Array:
    """Return offsets (n,2) from whole pixels (n,2) of an image to the corners beside them."""
    # Of gradients the smaller eigenvalue of the second moments, as Shi and Tomasi.
    strength = np.pad(cv2.cornerMinEigenVal(image, _WINDOW).astype(np.float64), _MARGIN, "edge")
    around = np.arange(-_MARGIN, _MARGIN + 1) + _MARGIN
    columns, rows = corners[:, :1] + around, corners[:, 1:] + around
    near = strength[rows[:, :, None], columns[:, None, :]]
    count, side = len(corners), 2 * _REACH + 1
    best = near[:, 1:-1, 1:-1].reshape(count, side * side).argmax(axis=1)
    y, x = best // side + 1, best % side + 1
    n, peak = np.arange(count), near[np.arange(count), y, x]
    across = _vertex(near[n, y, x - 1], peak, near[n, y, x + 1])
    along = _vertex(near[n, y - 1, x], peak, near[n, y + 1, x])
    return np.column_stack([x + across, y + along]) - _MARGIN


def _vertex(before: Array, peak: Array, after: Array) -> Array:
    """Return the vertex (n,) of the parabola through three values, at most a pixel away."""
    bend = before - 2.0 * peak + after
    apart = 0.5 * (before - after)
    vertex: Array = np.divide(apart, bend, np.zeros_like(bend), where=bend < 0.0)
    return np.clip(vertex, -1.0, 1.0)


Gray = NDArray[np.uint8]
Descriptors = NDArray[np.uint8]  # (n,d)

# Keypoints to choose from, as a multiple of those that are wanted, where OpenCV has to be told.
_CHOICE = 4
# COLMAP's threshold: its peak_threshold of 0.02 / 3 is OpenCV's before the division by layers.
_SIFT_CONTRAST = 0.02
# OpenCV takes pixel x of the doubled image for x / 2; it is (x + 0.5) / 2 - 0.5.
_SIFT_OFFSET = -0.25
# COLMAP's factor for the square roots, which fills a byte.
_SIFT_SCALE = 512.0
# Steps of brightness around a corner; ORB-SLAM (Mur-Artal et al., T-RO 2015) takes 20, or 7.
_FAST_THRESHOLD = 10
# Keypoints lie at least so far (px of their level) inside; the descriptor reaches 15 px.
_ORB_EDGE = 19
_ORB_LEVELS, _ORB_STEP = 8, 1.2
# A quarter of OpenCV's.
_AKAZE_THRESHOLD = 0.00025


@dataclass(frozen=True, slots=True)
class _Method:
    """One way to find keypoints and to describe them.

    ``find`` and ``describe`` of OpenCV repeat much of each other's work. ``at_once`` says that to
    describe all that is found costs less than that.
    """

    create: Callable[[int], Any]  # OpenCV's detector for this many keypoints
    at_once: bool
    place: Callable[[Gray, Sequence[Any]], Array]  # pixels (n,2) of keypoints, sub-pixel, unbiased


def _root(descriptors: NDArray[Any]) -> Descriptors:
    """Convert SIFT as COLMAP does: L1-normalized, square roots, times 512 in bytes.

    Arandjelovic, Zisserman, *Three things everyone should know to improve object retrieval*, CVPR
    2012. Euclidean distances of these numbers are Hellinger distances of the histograms.
    """
    values = descriptors.astype(np.float64)
    sums = np.maximum(values.sum(axis=1, keepdims=True), 1e-12)
    roots: Array = np.minimum(np.rint(_SIFT_SCALE * np.sqrt(values / sums)), 255.0)
    return roots.astype(np.uint8)


def _orb(count: int) -> Any:
    return cv2.ORB.create(
        _CHOICE * count,
        scaleFactor=_ORB_STEP,
        nlevels=_ORB_LEVELS,
        edgeThreshold=_ORB_EDGE,
        fastThreshold=_FAST_THRESHOLD,
    )


def _akaze(_: int) -> Any:
    # OpenCV 5 has it in its contrib modules only, where an older one has none.
    for module in (cv2, getattr(cv2, "xfeatures2d", None)):
        if (akaze := getattr(module, "AKAZE", None)) is not None:
            return akaze.create(threshold=_AKAZE_THRESHOLD)
    raise ValueError(
        f"OpenCV {cv2.__version__} has no AKAZE: take sift or orb, or install "
        f'"opencv-python-headless<5" or opencv-contrib-python-headless'
    )


def _points(keypoints: Sequence[Any]) -> Array:
    return np.array([keypoint.pt for keypoint in keypoints], np.float64).reshape(-1, 2)


def _orb_place(image: Gray, keypoints: Sequence[Any]) -> Array:
    octaves = np.array([keypoint.octave for keypoint in keypoints], np.int64)
    scale = _ORB_STEP**octaves
    corners = np.rint(_points(keypoints) / scale[:, None]).astype(np.int64)
    return refine_corners(image, corners, octaves, _ORB_STEP)


_METHODS: dict[str, _Method] = {
    FeatureKind.SIFT: _Method(
        lambda _: cv2.SIFT.create(contrastThreshold=_SIFT_CONTRAST), False,
        lambda _, found: _points(found) + _SIFT_OFFSET,
    ),
    FeatureKind.ORB: _Method(_orb, False, _orb_place),
    FeatureKind.AKAZE: _Method(_akaze, True, lambda _, found: _points(found)),
}  # fmt: skip


def kind_of(landmarks: Map) -> str:
    """Return the kind of features that match the descriptors of a map.

    Raises:
        ValueError: for a map without descriptors.
    """
    if landmarks.descriptors is None:
        raise ValueError("the map has no descriptors: keypoints of images cannot be matched to it")
    if landmarks.descriptors.dtype == np.float32:
        return FeatureKind.SIFT.value
    orb = landmarks.descriptors.shape[1] == _ORB_BYTES
    return (FeatureKind.ORB if orb else FeatureKind.AKAZE).value


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
        ValueError: for another kind, or one that this OpenCV does not have.
    """

    def __init__(self, kind: str, most: int) -> None:
        if kind not in _METHODS:
            raise ValueError(f"features must be one of {', '.join(_METHODS)}; got {kind!r}")
        self._method = _METHODS[kind]
        self._is_sift = kind == FeatureKind.SIFT
        self._most = most
        self._detector = self._method.create(most)

    def extract(self, image: Gray) -> Features:
        """Return the keypoints of an image (h,w)."""
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
            else:
                detected = self._detector.detect(image)
            scores = np.array([keypoint.response for keypoint in detected])
            size = image.shape[1], image.shape[0]
            rows = choose_balanced(_points(detected), scores, size, self._most)
            detected = [detected[row] for row in rows.tolist()]
            if not self._method.at_once:
                # Some keypoints are too near the rim and are dropped, and others change their
                # places.
                detected, descriptors = self._detector.compute(image, detected)
            elif descriptors is not None:
                descriptors = descriptors[rows]
        if descriptors is None:
            detected, descriptors = (), np.zeros((0, self._detector.descriptorSize()))
        return Features(
            _single(self._method.place(image, detected)),
            _single(np.array([keypoint.response for keypoint in detected])),
            _single(np.array([keypoint.size for keypoint in detected])),
            _root(descriptors) if self._is_sift else np.ascontiguousarray(descriptors, np.uint8),
        )


def _single(values: Array) -> Array:
    """Round numbers to single precision."""
    return values.astype(np.float32).astype(np.float64)


# Blue, green, red.
_COLOR = (0, 230, 255)
_LEAST_RADIUS = 2
# Digits after the point of drawn coordinates, in bits.
_SHIFT = 4


def draw_features(image: NDArray[np.uint8], features: Features) -> NDArray[np.uint8]:
    """Return the image (h,w,3) with a circle around the region of each descriptor."""
    picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    middles = np.rint(features.pixels * 2**_SHIFT).astype(int).tolist()
    radii = np.maximum(features.sizes / 2, _LEAST_RADIUS) * 2**_SHIFT
    for middle, radius in zip(middles, np.rint(radii).astype(int).tolist(), strict=True):
        cv2.circle(picture, middle, radius, _COLOR, 1, cv2.LINE_AA, _SHIFT)
    return picture
