"""Markers in images whose places nobody knows yet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.families import Family
from rs_localizer.markers.map_check import whole_markers
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Marker

# Smaller ones (px) may be anything, and their corners say little.
LEAST_SIDE = 12.0


@dataclass(frozen=True, slots=True, eq=False)
class Spotted:
    """The markers of one image of which all four corners were found."""

    stamp_ns: int
    markers: IntArray  # (m,) places in the list of all markers
    quads: Array  # (m,4,2) raw pixels: top left, top right, bottom right, bottom left


def every_marker(
    families: Sequence[Family], size: float, sizes: Mapping[int, float]
) -> tuple[Marker, ...]:
    """All markers of some families, all of them at the origin.

    Args:
        families: of different kinds.
        size: m, side of the black square.
        sizes: of those ids that differ.
    """
    return tuple(
        Marker.at(family.name, id_, sizes.get(id_, size), Pose())
        for family in families
        for id_ in range(family.count)
    )


class Spotter:
    """Finds markers of some families, whichever they are.

    Raises:
        MarkerMapError: for families that this OpenCV does not know.
    """

    def __init__(self, markers: Sequence[Marker], min_side: float = LEAST_SIDE) -> None:
        self._detector = MarkerDetector(MarkerMap(tuple(markers)), min_side)
        self._end = 4 * len(markers)

    def spot(self, image: NDArray[np.uint8], stamp_ns: int) -> Spotted:
        """The markers of an image (h,w)."""
        found = self._detector.detect(image, stamp_ns)
        whole = whole_markers(found, self._end)
        quads = [found.pixels[rows] for rows in whole.values()]
        return Spotted(stamp_ns, np.array(list(whole), np.int64), np.array(quads).reshape(-1, 4, 2))
