# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Markers of OpenCV, alike from OpenCV 4.6 to 5: their patterns and their detection.

OpenCV holds the AprilTag patterns upside down (4.x and 5.0; a later version will not, see
https://github.com/opencv/opencv/pull/28823). It draws them rotated by half and gives their corners
from the bottom right one on. Here a marker is upright as its family's authors print it: the pattern
of id 0 is known, and every dictionary is rotated by it.
"""

from collections.abc import Collection
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.markers.families import Family

Gray = NDArray[np.uint8]

# Before OpenCV 4.10, the outer one of two candidates wins if they are nearer than this share of the
# perimeter. At the default of 0.05, a white rim of one cell before a darker wall hides the marker
# in it.
_NEAREST = 0.02

_aruco: Any = getattr(cv2, "aruco", None)


class DictionaryError(ValueError):
    """A request that this OpenCV cannot serve; the message says what is missing."""


def pattern(family: Family, id_: int) -> NDArray[np.bool_]:
    """Return the cells (n,n) of an upright marker with its black border; true is white."""
    if not 0 <= id_ < family.count:
        raise ValueError(f"{family.name} has the ids 0 to {family.count - 1}, found {id_}")
    inside = np.rot90(_bits(family, id_), _turns(family))
    return np.pad(inside, family.border).astype(bool)


class MarkerFinder:
    """Finds the markers of one family.

    Args:
        family: of the markers.
        ids: the only ones to look for; None: all. OpenCV compares every dark quadrilateral with
            every pattern, so that a few are found several times faster than a thousand.

    Raises:
        DictionaryError: when this OpenCV does not know the family.
    """

    def __init__(self, family: Family, ids: Collection[int] | None = None) -> None:
        self.family = family
        self._turns = _turns(family)
        self._ids = np.arange(family.count) if ids is None else np.array(sorted(ids), np.int64)
        dictionary = _dictionary(family) if ids is None else _part(family, self._ids)
        if hasattr(_aruco, "ArucoDetector"):
            parameters = _configured(_aruco.DetectorParameters(), family)
            self._find = _aruco.ArucoDetector(dictionary, parameters).detectMarkers
        else:
            parameters = _configured(_aruco.DetectorParameters_create(), family)
            self._find = lambda image: _aruco.detectMarkers(
                image, dictionary, parameters=parameters
            )

    def find(self, image: Gray) -> tuple[NDArray[np.int64], Array]:
        """Return ids (m,) and corners (m,4,2), clockwise from the upright print's top left one.

        The corners are within a pixel or so (see :mod:`rs_localizer.markers.edges`).
        """
        corners, ids, _ = self._find(image)
        if ids is None or len(ids) == 0:
            return np.empty(0, np.int64), np.empty((0, 4, 2))
        quads = np.concatenate(corners).reshape(-1, 4, 2).astype(np.float64)
        own_ids = self._ids[np.asarray(ids, np.int64).ravel()]
        return own_ids, np.roll(quads, -self._turns, axis=1)


def _configured(parameters: Any, family: Family) -> Any:
    parameters.markerBorderBits = family.border
    # OpenCV's refinements are not used: the AprilTag one is off by 0.46 px along x and y, and the
    # sub-pixel search moves the corners of a blurred marker inwards by 0.1 to 0.4 px.
    parameters.cornerRefinementMethod = _aruco.CORNER_REFINE_NONE
    if not hasattr(parameters, "minGroupDistance"):
        parameters.minMarkerDistanceRate = _NEAREST
    return parameters


@lru_cache(maxsize=32)
def _dictionary(family: Family) -> Any:
    if _aruco is None:
        raise DictionaryError(
            f"OpenCV {cv2.__version__} is installed without its aruco module; before OpenCV 4.7 "
            "that is in opencv-contrib-python-headless"
        )
    number = getattr(_aruco, family.constant, None)
    if number is None:
        raise DictionaryError(f"OpenCV {cv2.__version__} does not know the family {family.name}")
    return _aruco.getPredefinedDictionary(number)


def _part(family: Family, ids: NDArray[np.int64]) -> Any:
    """Return a dictionary of some ids, which corrects as many bits as the whole family does."""
    whole = _dictionary(family)
    part = _aruco.getPredefinedDictionary(getattr(_aruco, family.constant))  # a copy
    part.bytesList = np.ascontiguousarray(whole.bytesList[ids])
    return part


def _bits(family: Family, id_: int) -> NDArray[np.uint8]:
    row = _dictionary(family).bytesList[id_ : id_ + 1]
    return np.asarray(_aruco.Dictionary_getBitsFromByteList(row, family.bits), np.uint8)


@lru_cache(maxsize=32)
def _turns(family: Family) -> int:
    """Return the quarter turns, anticlockwise, that make OpenCV's pattern upright."""
    bits = _bits(family, 0)
    for turns in range(4):
        if int("".join(map(str, np.rot90(bits, turns).ravel())), 2) == family.first:
            return turns
    raise DictionaryError(
        f"OpenCV {cv2.__version__} has another pattern for {family.name} 0 than is known here"
    )
