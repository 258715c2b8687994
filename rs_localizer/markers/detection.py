# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images -> corners of the map's markers and boards: the correspondences of one frame.

The node and the offline command run this one class, so the same images give the same corners.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.markers.boards import charuco_fault, find_charuco, find_chessboard
from rs_localizer.markers.dictionaries import DictionaryError, Gray, MarkerFinder
from rs_localizer.markers.edges import refine
from rs_localizer.markers.families import Family
from rs_localizer.markers.maps import MarkerMap, MarkerMapError
from rs_localizer.markers.prints import Board, Charuco

IntArray = NDArray[np.int64]

# After this long without a board (ns) it may lie the other way round.
_LONGEST_LOSS_NS = 1_000_000_000
# Other markers of a family larger than this are looked for in the first images, and then in one of
# this many: they are only told of, and a large family takes several times as long.
_LARGE, _FIRST_IMAGES, _ONE_IN = 100, 5, 30


@dataclass(frozen=True, slots=True, eq=False)
class MarkerQuads:
    """Markers of one kind in an image."""

    family: Family
    ids: IntArray  # (m,)
    quads: Array  # (m,4,2) px
    exact: NDArray[np.bool_]  # (m,4) which corners are exact
    mapped: NDArray[np.bool_]  # (m,) which are in the map, and only once in the image


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Corners of the map that one image shows."""

    ids: IntArray  # (n,) rows of MarkerMap.points
    points: Array  # (n,3) m, map frame
    pixels: Array  # (n,2) raw pixels, centre of the first one at 0, 0
    scores: Array  # (n,) px: shortest side of the marker, or distance to the next corner
    markers: tuple[MarkerQuads, ...]  # all that were seen, for pictures and messages
    boards: tuple[tuple[str, Array], ...]  # names and pixels (k,2) of those that were seen
    unknown: tuple[str, ...]  # markers that are not in the map
    repeated: tuple[str, ...]  # markers that the image shows more than once: not used
    faults: tuple[str, ...] = ()  # boards that are not as the map has them: not used


class MarkerDetector:
    """Finds the markers and boards of a map.

    Detections of the map depend on the image alone; for a board that looks the same rotated, also
    on the image before. For large families :attr:`Detections.unknown` is only filled from time to
    time.

    Args:
        marker_map: what to look for.
        min_side: markers with a shorter side (px) are left out.

    Raises:
        MarkerMapError: for a map that this OpenCV cannot look for.
    """

    def __init__(self, marker_map: MarkerMap, min_side: float = 0.0) -> None:
        self.map = marker_map
        self._min_side = min_side
        self._points = marker_map.points
        self._finders = _finders(marker_map)
        self._images = 0
        self._places: dict[tuple[str, int], int] = {}  # kind and id of a marker -> row
        row = 0
        for marker in marker_map.markers:
            self._places[marker.family.kind, marker.id] = row
            row += 4
        self._boards: list[tuple[int, Board]] = []
        self._on_boards: set[tuple[str, int]] = set()
        for board in marker_map.boards:
            self._boards.append((row, board))
            row += len(board.points)
            if isinstance(board, Charuco):
                self._on_boards |= {(m.family.kind, m.id) for m in board.markers}
        self._last_board: Array | None = None  # how it lay in the last image
        self._last_board_ns = 0

    def detect(self, image: Gray, stamp_ns: int = 0) -> Detections:
        """Detect all corners of the map that an image shows.

        Args:
            image: (h,w) uint8.
            stamp_ns: for boards that look the same turned by half: they keep their order from
                image to image, unless they were lost for a second or time went back.

        Raises:
            ValueError: for another kind of array.
        """
        if image.dtype != np.uint8 or image.ndim != 2 or 0 in image.shape:
            raise ValueError(f"an image must be (h,w) uint8, got {image.dtype} {image.shape}")
        image = np.ascontiguousarray(image)
        everything = self._images < _FIRST_IMAGES or self._images % _ONE_IN == 0
        self._images += 1
        observations = [
            self._quads(all_ if everything else own, image) for own, all_ in self._finders
        ]
        parts = [self._corners(item) for item in observations]
        boards = []
        self._faults: list[str] = []
        for row, board in self._boards:
            rows, pixels = self._board(image, board, observations, stamp_ns)
            if len(rows):
                parts.append((row + rows, pixels, _spacings(pixels)))
                boards.append((board.name, pixels))
        rows = np.concatenate([np.empty(0, np.int64), *(part[0] for part in parts)])
        return Detections(
            ids=rows,
            points=self._points[rows],
            pixels=np.concatenate([np.empty((0, 2)), *(part[1] for part in parts)]),
            scores=np.concatenate([np.empty(0), *(part[2] for part in parts)]),
            markers=tuple(observations),
            boards=tuple(boards),
            unknown=tuple(
                f"{item.family.name} {i}"
                for item in observations
                for i in np.unique(item.ids).tolist()
                if not self._knows(item.family, i)
            ),
            repeated=tuple(
                f"{item.family.name} {i}" for item in observations for i in _twice(item.ids)
            ),
            faults=tuple(self._faults),
        )

    def _quads(self, finder: MarkerFinder, image: Gray) -> MarkerQuads:
        family = finder.family
        ids, quads = finder.find(image)
        order = np.argsort(ids, kind="stable")  # OpenCV's threads may give any order
        ids, quads = ids[order], np.ascontiguousarray(quads[order])
        large = _sides(quads) >= self._min_side
        ids, quads = ids[large], quads[large]
        exact = refine(image, quads, family.cells)
        different = _different(ids, quads, exact)
        ids, quads, exact = ids[different], quads[different], exact[different]
        mapped = np.array([self._knows(family, i) for i in ids.tolist()], bool)
        return MarkerQuads(family, ids, quads, exact, mapped & ~np.isin(ids, _twice(ids)))

    def _knows(self, family: Family, id_: int) -> bool:
        key = (family.kind, id_)
        return key in self._places or key in self._on_boards

    def _corners(self, observations: MarkerQuads) -> tuple[IntArray, Array, Array]:
        """Return the rows, pixels and scores of the single markers."""
        rows = [
            self._places.get((observations.family.kind, i), -1) for i in observations.ids.tolist()
        ]
        first = np.array(rows, np.int64)
        used = observations.exact & (observations.mapped & (first >= 0))[:, None]
        corners = (first[:, None] + np.arange(4))[used]
        scores = np.broadcast_to(_sides(observations.quads)[:, None], used.shape)[used]
        return corners, observations.quads[used], scores

    def _board(
        self, image: Gray, board: Board, observations: list[MarkerQuads], stamp_ns: int
    ) -> tuple[IntArray, Array]:
        """Return the rows of the board's points, and their pixels."""
        if isinstance(board, Charuco):
            (item,) = (item for item in observations if item.family.kind == board.family.kind)
            last = board.first_id + len(board.cells)
            own = item.mapped & (item.ids >= board.first_id) & (item.ids < last)
            own &= item.exact.all(axis=1)
            if fault := charuco_fault(board, item.ids[own], item.quads[own]):
                self._faults.append(fault)
                return np.empty(0, np.int64), np.empty((0, 2))
            return find_charuco(image, board, item.ids[own], item.quads[own])
        if not 0 <= stamp_ns - self._last_board_ns <= _LONGEST_LOSS_NS:
            self._last_board = None
        corners = find_chessboard(image, board, self._last_board)
        if corners is None:
            return np.empty(0, np.int64), np.empty((0, 2))
        self._last_board, self._last_board_ns = corners, stamp_ns
        return np.arange(len(corners)), corners


def _finders(marker_map: MarkerMap) -> list[tuple[MarkerFinder, MarkerFinder]]:
    """Return two finders per kind of family: of the map's ids, if it is faster, and of all ids."""
    families: dict[str, Family] = {}
    ids: dict[str, set[int]] = {}
    for marker, _ in marker_map.all_markers():
        kind = marker.family.kind
        largest = families.setdefault(kind, marker.family)
        ids.setdefault(kind, set()).add(marker.id)
        if marker.family.count > largest.count:
            families[kind] = marker.family
    try:
        return [
            (MarkerFinder(family, ids[kind]) if family.count > _LARGE else everything, everything)
            for kind, family in families.items()
            for everything in [MarkerFinder(family)]
        ]
    except DictionaryError as error:
        raise MarkerMapError(str(error)) from error


def _different(ids: IntArray, quads: Array, exact: NDArray[np.bool_]) -> IntArray:
    """Return rows of quadrilaterals to keep if OpenCV (4.6) gives one marker twice."""
    keep: list[int] = []
    for m in range(len(ids)):
        if keep and ids[keep[-1]] == ids[m]:
            apart = np.linalg.norm(quads[m].mean(axis=0) - quads[keep[-1]].mean(axis=0))
            if apart < 0.5 * _sides(quads[m : m + 1])[0]:
                if exact[m].sum() > exact[keep[-1]].sum():
                    keep[-1] = m
                continue
        keep.append(m)
    return np.array(keep, np.int64)


def _twice(ids: IntArray) -> IntArray:
    """Return the ids that occur more than once."""
    values, counts = np.unique(ids, return_counts=True)
    return values[counts > 1]


def _sides(quads: Array) -> Array:
    """Return the shortest side (m,) of quadrilaterals (m,4,2)."""
    return np.asarray(np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2).min(axis=1))


def _spacings(pixels: Array) -> Array:
    """Return the distance (n,) of each pixel (n,2) to its nearest neighbour."""
    apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    nearest = apart.min(axis=1)
    return np.where(np.isfinite(nearest), nearest, 0.0)
