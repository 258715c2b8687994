# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer markers make|check``: prints with their map file, and checks of map files."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from rs_localizer.cli import WORKING, UsageError, add_common, integer, number, read_counts
from rs_localizer.markers.families import FAMILIES, family
from rs_localizer.markers.printing import PAGES, page_files, plan, write_pages

if WORKING:
    from rs_localizer.io.atomic_files import atomic_files
    from rs_localizer.markers.map_check import other_units
    from rs_localizer.markers.map_files import read_marker_map, write_marker_map
    from rs_localizer.markers.maps import MarkerMap, wall
    from rs_localizer.markers.poses import Pose
    from rs_localizer.markers.prints import Board, Charuco, Chessboard

# Six markers that fill a page of A4 or letter.
_FAMILY, _GRID, _SIZE, _GAP = "4x4_50", "2x3", 0.06, 0.02
_SQUARE = 0.03
# Of a ChArUco board: as large as leaves the marker enough white.
_MARKER_SHARE = 0.75
# A print that stands: x to the right, z up, y into the wall.
_STANDING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="action", required=True, metavar="make|check")
    make = commands.add_parser(
        "make",
        help="a PDF or PNG to print, true to scale, and its map",
        description="Write OUT.pdf, to be printed at 100 %, and its map OUT.yaml.",
    )
    make.add_argument("out", type=Path, metavar="OUT", help="path of both files, without ending")
    above = number(0.0, above=True)
    kind = make.add_mutually_exclusive_group()
    kind.add_argument(
        "--grid",
        metavar="2x3",
        help=f"markers, columns x rows (default: {_GRID}); what does not fit on a page together "
        "is to be cut out and mounted as in the map",
    )
    kind.add_argument("--chessboard", metavar="6x4", help="inner corners, along a row x rows")
    kind.add_argument("--charuco", metavar="5x7", help="squares, along a row x rows")
    make.add_argument(
        "--family", help=f"of the markers: {', '.join(FAMILIES)} (default: {_FAMILY})"
    )
    make.add_argument(
        "--size", type=above, metavar="M", help=f"side of a marker (default: {_SIZE})"
    )
    make.add_argument(
        "--gap", type=number(0.0), metavar="M", help=f"between the markers of a grid ({_GAP})"
    )
    make.add_argument("--first-id", type=integer(0), metavar="N", help="id of the first (0)")
    make.add_argument(
        "--square", type=above, metavar="M", help=f"side of a board's squares (default: {_SQUARE})"
    )
    make.add_argument(
        "--marker",
        type=above,
        metavar="M",
        help=f"side of a ChArUco board's markers (default: {_MARKER_SHARE} squares)",
    )
    make.add_argument("--page", choices=sorted(PAGES), default="a4", help="(default: %(default)s)")
    make.add_argument("--format", choices=["pdf", "png"], default="pdf")
    make.add_argument("--map-frame", default="map", help="(default: %(default)s)")
    make.add_argument(
        "--standing",
        action="store_true",
        help="map frame with z up and y into the wall; otherwise x is to the right, y up and z "
        "toward the viewer, which is right for a print that lies on a table",
    )
    make.add_argument("--overwrite", action="store_true", help="replace earlier files")
    check = commands.add_parser(
        "check",
        help="check a map file",
        description="Read a map and look for sizes in other units.",
    )
    check.add_argument("map", type=Path, metavar="MAP")
    for action in (make, check):
        add_common(action)


def run(args: argparse.Namespace) -> dict[str, object]:
    return _make(args) if args.action == "make" else _check(args.map)


def _make(args: argparse.Namespace) -> dict[str, object]:
    try:
        marker_map = _map(args)
    except ValueError as error:  # the arguments are all that can be wrong with it
        raise UsageError(str(error)) from error
    for fault in other_units(marker_map):
        raise UsageError(fault)
    # An ending would be lost with a dot in the name.
    target = Path(f"{args.out}.{args.format}")
    map_file = Path(f"{args.out}.yaml")
    pages = plan(marker_map, args.page)
    written = (*page_files(target, len(pages)), map_file)
    for path in written:
        if path.exists() and not args.overwrite:
            raise ValueError(f"{path} exists already; it is replaced with --overwrite")
    with atomic_files(*written) as (*_, map_part):
        write_pages(pages, map_part.with_name(target.name))
        write_marker_map(map_part, marker_map)
    files = written[:-1]
    shown = str(files[0]) if len(files) == 1 else f"{files[0]} ... {files[-1].name}"
    count = f"{len(pages)} page{'s' if len(pages) > 1 else ''} of {args.page}"
    print(f"{shown}: {count}; print at 100 % and measure the bar")
    print(f"{map_file}: {len(marker_map.points)} corners in {marker_map.map_frame}")
    if marker_map.markers and len(pages) > 1:
        print("the markers do not fit on a page together: mount each where the map has it")
    return {"pages": files, "map": map_file, "corners": len(marker_map.points)}


def _map(args: argparse.Namespace) -> MarkerMap:
    pose = Pose(np.zeros(3), _STANDING if args.standing else np.eye(3))
    if args.chessboard is None and args.charuco is None:
        _refuse(args, "a board", "square", "marker")
        grid = read_counts(args.grid or _GRID, "--grid")
        size = args.size or _SIZE
        gap = _GAP * size / _SIZE if args.gap is None else args.gap
        markers = wall(
            args.family or _FAMILY, grid, *(size, gap), first_id=args.first_id or 0, pose=pose
        )
        return MarkerMap(markers, map_frame=args.map_frame)
    _refuse(args, "a grid", "size", "gap")
    square = args.square or _SQUARE
    if args.chessboard is not None:
        _refuse(args, "markers", "family", "first_id", "marker")
        board: Board = Chessboard(*read_counts(args.chessboard, "--chessboard"), square, pose=pose)
    else:
        columns, rows = read_counts(args.charuco, "--charuco")
        marker = args.marker or _MARKER_SHARE * square
        chosen = family(args.family or _FAMILY)
        board = Charuco(columns, rows, square, marker, chosen, args.first_id or 0, pose=pose)
    return MarkerMap(boards=(board,), map_frame=args.map_frame)


def _refuse(args: argparse.Namespace, what: str, *names: str) -> None:
    for name in names:
        if getattr(args, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} is for {what}")


def _check(path: Path) -> dict[str, object]:
    marker_map = read_marker_map(path)
    faults = list(other_units(marker_map))
    for text in faults:
        print(text)
    if faults:
        count = "a problem" if len(faults) == 1 else f"{len(faults)} problems"
        raise ValueError(f"{path} has {count}")
    kinds = sorted({marker.family.name for marker, _ in marker_map.all_markers()})
    of = f" of {', '.join(kinds)}" if kinds else ""
    print(
        f"{path}: {len(marker_map.markers)} markers and {len(marker_map.boards)} boards{of} in "
        f"{marker_map.map_frame}; no problem found"
    )
    return {
        "markers": len(marker_map.markers), "boards": len(marker_map.boards),
        "families": kinds, "map_frame": marker_map.map_frame,
    }  # fmt: skip
