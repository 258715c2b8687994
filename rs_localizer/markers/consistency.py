# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a map of markers can be true by itself: overlaps, mirrored markers, other units.

:mod:`rs_localizer.markers.map_check` holds it against images.
"""

from collections.abc import Iterator

import numpy as np

from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Board, Marker

# Prints within this distance of a plane (in sides of the marker) and this angle are in one.
SAME_PLANE, PARALLEL = 0.2, np.cos(np.radians(5.0))
# A marker this many times larger than the median has its size in another unit, and so have all of
# them if they are larger than any that is printed (m).
_OTHER_UNIT, _LARGEST = 20.0, 5.0
# Squares and circles of boards are farther apart than this (m) on no print.
_LARGEST_SQUARE = 2.0


def problems(marker_map: MarkerMap) -> list[str]:
    """What is wrong with a map that could be read; empty if nothing is."""
    plates = [_Plate(item) for item in (*marker_map.markers, *marker_map.boards)]
    return [*other_units(marker_map), *(text for a, b in _near(plates) for text in _pair(a, b))]


class _Plate:
    """A print as a rectangle, with the white rim that it needs."""

    def __init__(self, item: Marker | Board) -> None:
        self.name = item.name
        self.pose = item.pose
        if isinstance(item, Marker):
            width = height = self.side = item.size
            self.rim = item.size / item.family.cells
        else:
            width, height = item.extent
            self.side = self.rim = item.spacing
        x, y = 0.5 * width, 0.5 * height
        # What :func:`_pair` looks at is within the reaches of both.
        self.reach = float(np.hypot(x, y)) + 2.0 * self.side
        self.corners = self.pose(np.array([[-x, y, 0], [x, y, 0], [x, -y, 0], [-x, -y, 0]]))


def _near(plates: list[_Plate]) -> Iterator[tuple[_Plate, _Plate]]:
    """Pairs that may have to do with each other: of a thousand markers, few."""
    middles = np.array([plate.pose.position for plate in plates])
    reaches = np.array([plate.reach for plate in plates])
    for k, plate in enumerate(plates):
        apart = np.linalg.norm(middles[k + 1 :] - middles[k], axis=1)
        for other in np.flatnonzero(apart <= reaches[k + 1 :] + reaches[k]).tolist():
            yield plate, plates[k + 1 + other]


def other_units(marker_map: MarkerMap) -> Iterator[str]:
    """What speaks for sizes that are not in metres."""
    for board in marker_map.boards:
        if board.spacing > _LARGEST_SQUARE:
            yield (
                f"{board.name} with {board.spacing:g} m from corner to corner: sizes are in "
                f"metres; {1e-3 * board.spacing:g} would be {board.spacing:g} mm"
            )
    if not marker_map.markers:
        return
    usual = float(np.median([marker.size for marker in marker_map.markers]))
    if usual > _LARGEST:
        yield f"markers of {usual:g} m: are sizes and positions, given in metres, in another unit?"
    for marker in marker_map.markers:
        if not usual / _OTHER_UNIT <= marker.size <= usual * _OTHER_UNIT:
            yield (
                f"{marker.name} has a size of {marker.size:g} m, where {usual:g} m is usual: "
                "is it in another unit?"
            )


def _pair(a: _Plate, b: _Plate) -> Iterator[str]:
    """What is wrong with two prints in one plane."""
    side = max(a.side, b.side)
    normal = a.pose.rotation[:, 2]
    same_way = float(normal @ b.pose.rotation[:, 2])
    off = abs(float(normal @ (b.pose.position - a.pose.position)))
    if abs(same_way) < PARALLEL or off > SAME_PLANE * side:
        return
    gap = _gap(a, b)
    if same_way < 0.0:
        if gap < 2.0 * side:
            yield (
                f"{a.name} and {b.name} are in one plane but face opposite ways: one of them is "
                "mirrored (corners go clockwise as seen from the front)"
            )
    elif gap < 0.0:
        yield f"{a.name} and {b.name} overlap by {-gap:.4g} m"
    elif gap < 0.99 * min(a.rim, b.rim):
        yield (
            f"{a.name} and {b.name} are {gap:.4g} m apart: each needs a white rim of a cell, "
            f"{max(a.rim, b.rim):.4g} m"
        )


def _gap(a: _Plate, b: _Plate) -> float:
    """Distance between two rectangles in a plane along the best separating axis (m)."""
    axes = np.vstack([a.pose.rotation[:, :2].T, b.pose.rotation[:, :2].T])
    first, second = a.corners @ axes.T, b.corners @ axes.T
    gaps = np.maximum(
        first.min(axis=0) - second.max(axis=0), second.min(axis=0) - first.max(axis=0)
    )
    return float(gaps.max())
