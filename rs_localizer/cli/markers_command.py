# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer markers make``: prints of markers or a board, with their map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rs_localizer.cli import read_counts, refuse_existing
from rs_localizer.cli.options import ResultOptions, UsageError, argument, option
from rs_localizer.io.atomic_files import atomic_files
from rs_localizer.markers.families import FAMILIES, family
from rs_localizer.markers.map_files import write_marker_map
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.markers.prints import Charuco, Chessboard, Pose
from rs_localizer.tools.printing import PAGES, largest_side, plan, write_pages

# Six markers, which fill a page. Where more would be smaller than this (m), each has a page of its
# own: smaller ones are not seen from a few metres.
_FAMILY, _GRID, _SIZE, _SQUARE = "4x4_50", "2x3", 0.06, 0.03
# Gap between the markers of a grid, over their size. Side of a ChArUco board's markers over its
# squares: as large as leaves a marker enough white.
_GAP, _MARKER = 1.0 / 3.0, 0.75
# A print that stands: x to the right, z up, y into the wall.
_STANDING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, kw_only=True)
class Options(ResultOptions):
    out: Path = argument("OUT.pdf to print, and beside it the map OUT.yaml", "OUT")
    grid: str | None = option(
        f"markers, columns x rows (default: {_GRID}); where they do not fit on a page together, "
        "each has its own and is mounted as in the map", "2x3",
    )  # fmt: skip
    chessboard: str | None = option("instead: inner corners, along a row x rows", "6x4")
    charuco: str | None = option("instead: squares, along a row x rows", "5x7")
    family: str = option(f"of the markers: {', '.join(FAMILIES)}", "NAME", _FAMILY)
    size: float | None = option(
        f"side of a marker or of a board's squares (default: what fills the page, but at least "
        f"{_SIZE} or {_SQUARE})", "M",
        above=0.0,
    )  # fmt: skip
    first_id: int = option("id of the first marker", "N", 0, least=0.0)
    page: str = option("of paper", default="a4", choices=sorted(PAGES))
    standing: bool = option(
        "map frame with z up and y into the wall; otherwise x is to the right, y up and z towards "
        "the viewer, which is right for a print that lies on a table", default=False,
    )  # fmt: skip


def run(options: Options) -> dict[str, object]:
    try:
        marker_map = _map(options)
    except ValueError as error:  # the options are all that can be wrong with it
        raise UsageError(str(error)) from error
    pages = plan(marker_map, options.page)
    prints = options.out if options.out.suffix == ".pdf" else Path(f"{options.out}.pdf")
    written = prints, map_file = prints, prints.with_suffix(".yaml")
    refuse_existing(options, *written)
    with atomic_files(*written) as (part, map_part):
        write_pages(pages, part)
        write_marker_map(map_part, marker_map)
    count = f"{len(pages)} page{'s' if len(pages) > 1 else ''} of {options.page}"
    print(f"{prints}: {count}; print at 100 % and measure the bar")
    print(f"{map_file}: {len(marker_map.points)} corners in {marker_map.map_frame}")
    if len(pages) > 1:
        print("the markers do not fit on a page together: mount each where the map has it")
    return {"pages": [prints], "map": map_file, "corners": len(marker_map.points)}


def _map(options: Options) -> MarkerMap:
    pose = Pose(np.zeros(3), _STANDING if options.standing else np.eye(3))
    given = [name for name in ("grid", "chessboard", "charuco") if getattr(options, name)]
    if len(given) > 1:
        raise UsageError(f"give one of {', '.join(f'--{name}' for name in given)}")
    what = given[0] if given else "grid"
    counts = read_counts(getattr(options, what) or _GRID, f"--{what}")
    if what == "grid":
        sides = (count + (count - 1) * _GAP for count in counts)
        size = options.size or max(_SIZE, largest_side(options.page, *sides))
        first = options.first_id
        return MarkerMap(wall(options.family, counts, size, _GAP * size, first_id=first, pose=pose))
    squares = (count + (what == "chessboard") for count in counts)
    square = options.size or max(_SQUARE, largest_side(options.page, *squares))
    if what == "chessboard":
        return MarkerMap(boards=(Chessboard(*counts, square, pose=pose),))
    kind, marker = family(options.family), _MARKER * square
    return MarkerMap(boards=(Charuco(*counts, square, marker, kind, options.first_id, pose=pose),))
