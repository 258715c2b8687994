# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The map of markers: which ones there are, and where.

Its file is read and written by :mod:`rs_localizer.markers.map_files`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.markers.prints import Board, Charuco, Marker, Pose, flat_grid


class MarkerMapError(ValueError):
    """A map that cannot be used; the message names the file, the entry and the fault."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerMap:
    """Markers and boards in one frame.

    Raises:
        MarkerMapError: for a map without any, or with the same marker twice.
    """

    markers: tuple[Marker, ...] = ()
    boards: tuple[Board, ...] = ()
    map_frame: str = "map"

    def __post_init__(self) -> None:
        if not self.map_frame:
            raise MarkerMapError("map_frame is empty; it must name the frame of the poses")
        if self.map_frame.startswith("/"):
            raise MarkerMapError(f"map_frame must not start with '/', found {self.map_frame!r}")
        if not self.markers and not self.boards:
            raise MarkerMapError("there are neither markers nor boards")
        owners: dict[tuple[str, int], str] = {}
        for marker, owner in self.all_markers():
            key = (marker.family.kind, marker.id)
            if key in owners:
                raise MarkerMapError(
                    f"{marker.name} is there twice: as {owners[key]} and as {owner}"
                )
            owners[key] = owner
        alike = [board.name for board in self.boards if not isinstance(board, Charuco)]
        if len(alike) > 1:
            raise MarkerMapError(
                f"there are {len(alike)} boards without markers ({', '.join(alike)}), which cannot "
                "be told apart; use ChArUco"
            )

    def all_markers(self) -> Iterator[tuple[Marker, str]]:
        """Yield every marker, also of ChArUco boards, with the name of its board."""
        for marker in self.markers:
            yield marker, marker.name
        for board in self.boards:
            if isinstance(board, Charuco):
                for marker in board.markers:
                    yield marker, board.name

    @property
    def points(self) -> Array:
        """All corners (n,3) in the map frame: of the markers, then of the boards.

        The ``id`` of a detected corner is its row here.
        """
        return np.concatenate([item.points for item in (*self.markers, *self.boards)])

    @property
    def settings(self) -> dict[str, float]:
        """Settings that the localizer is to be told: ``map_deviation`` (m), rms over the boards.

        Markers are exact: what their places are worth is their survey's to say.
        """
        boards = [(len(board.points), board.points_deviation) for board in self.boards]
        if not boards:
            return {}
        counts, deviations = np.array(boards).T
        return {"map_deviation": float(np.sqrt(counts @ deviations**2 / counts.sum()))}

    def with_points(self, points: Array, deviation: float | None = None) -> MarkerMap:
        """Return the map with corners at (n,3) m, of boards known to a deviation (m)."""
        sizes = [len(item.points) for item in (*self.markers, *self.boards)]
        parts = np.split(points, np.cumsum(sizes)[:-1])
        own = len(self.markers)
        return replace(
            self,
            markers=tuple(
                replace(marker, corners=part)
                for marker, part in zip(self.markers, parts[:own], strict=True)
            ),
            boards=tuple(
                board.with_points(part, deviation)
                for board, part in zip(self.boards, parts[own:], strict=True)
            ),
        )


def wall(
    family_name: str,
    grid: tuple[int, int],
    size: float,
    gap: float,
    *,
    first_id: int = 0,
    pose: Pose | None = None,
) -> tuple[Marker, ...]:
    """Return a grid of markers, ids row by row from the top left.

    Args:
        family_name: see :func:`rs_localizer.markers.families.family`.
        grid: columns and rows of markers.
        size: side of a marker, m.
        gap: between the sides of neighbours, m.
        first_id: id of the top left marker.
        pose: of the middle of the wall: x to the right, y up, z towards the viewer.
    """
    pose = pose or Pose()
    middles = pose(flat_grid(*grid, size + gap))
    return tuple(
        Marker.at(family_name, first_id + index, size, Pose(middle, pose.rotation))
        for index, middle in enumerate(middles)
    )
