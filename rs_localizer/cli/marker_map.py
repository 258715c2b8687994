# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Targets in images: a marker map, or a board on its own."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rs_localizer.cli import WORKING, read_counts
from rs_localizer.cli.options import UsageError, option

if WORKING:
    from rs_localizer.markers.map_files import read_marker_map
    from rs_localizer.markers.maps import MarkerMap, other_units
    from rs_localizer.markers.poses import Pose
    from rs_localizer.markers.prints import Chessboard

# A board on its own is the map: its first corner is the origin, x along the rows, y from row to
# row, z away from the viewer.
_BOARD_AXES = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class TargetOptions:
    """what to look for: a map of markers, or one board."""

    map: Path | None = option("marker map; also that of keypoints, where they are read", "FILE")
    board: str | None = option("instead: inner corners along a row x rows of a chessboard", "6x4")
    square: float | None = option(
        "side of its squares in metres", "M", above=0.0
    )  # fmt: skip


def read_checked_map(path: Path) -> MarkerMap:
    """Read the map of a file, and warn of sizes in other units."""
    marker_map = read_marker_map(path)
    for fault in other_units(marker_map):
        print(f"warning: {path}: {fault}", file=sys.stderr)
    return marker_map


def find_map(args: TargetOptions) -> MarkerMap:
    """Return the given map, or the map of the given board.

    Raises:
        UsageError: when it is neither, or both.
    """
    if (args.map is None) == (args.board is None):
        raise UsageError("give either --map or --board")
    if args.map is not None:
        if args.square is not None:
            raise UsageError("--square goes with --board")
        return read_checked_map(args.map)
    if args.board is None or args.square is None:
        raise UsageError("--board needs --square")
    columns, rows = read_counts(args.board, "--board")
    try:
        board = Chessboard(columns, rows, args.square)
    except ValueError as error:
        raise UsageError(f"--board: {error}") from error
    # The first corner to the origin.
    pose = Pose(-_BOARD_AXES @ board.points[0], _BOARD_AXES)
    marker_map = MarkerMap(boards=(replace(board, pose=pose),))
    for fault in other_units(marker_map):
        raise UsageError(f"--square: {fault}")
    return marker_map
