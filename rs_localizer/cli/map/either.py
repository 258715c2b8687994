# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Maps of landmarks or of markers: what all actions on files of maps take, write and describe."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from rs_localizer.cli import WORKING, UsageError, number, refuse_existing
from rs_localizer.io.maps.files import SUFFIX, read_map_file
from rs_localizer.markers.formats import (
    FORMATS,
    OWN,
    SUFFIXES,
    USUAL_FAMILY,
    Unsaid,
    is_marker_file,
    read_any,
    write_any,
)

if WORKING:
    import numpy as np

    from rs_localizer.io.atomic_files import atomic_files
    from rs_localizer.io.maps.files import write_npz
    from rs_localizer.io.maps.landmarks import Map, make_map
    from rs_localizer.markers.families import family
    from rs_localizer.markers.maps import MarkerMap

_KINDS = (
    "landmarks: a .npz file or a folder of COLMAP; markers: a .yaml or .json file of "
    f"{', '.join(FORMATS)}"
)
_OUTPUTS = (SUFFIX, *SUFFIXES)


def add_input(parser: argparse.ArgumentParser) -> None:
    """The file, and what it may not say itself."""
    parser.add_argument("file", type=Path, metavar="FILE", help=_KINDS)
    parser.add_argument(
        "--database",
        type=Path,
        metavar="FILE",
        help="COLMAP's, for the descriptors (default: database.db, or the only database of any "
        "name, in the folder or one of the two above)",
    )
    foreign = parser.add_argument_group("markers: what files of other programs omit")
    foreign.add_argument("--family", help=f"(default: that of the file, or {USUAL_FAMILY.name})")
    foreign.add_argument("--size", type=number(0.0, above=True), metavar="M", help="of all markers")
    foreign.add_argument("--map-frame", metavar="NAME", help="(default: map)")
    foreign.add_argument("--part", metavar="NAME", help="of several bundles")


def add_output(parser: argparse.ArgumentParser) -> None:
    """Where to, and as what."""
    parser.add_argument("out", type=Path, metavar="OUT", help=f"ends in {', '.join(_OUTPUTS)}")
    parser.add_argument(
        "--to", choices=FORMATS, help="of markers (default: .json is of wpilib, .yaml our own)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace OUT")


def read(args: argparse.Namespace) -> tuple[Map | MarkerMap, str]:
    """The map that the arguments name, and the name of its format, empty for landmarks."""
    if is_marker_file(args.file):
        return read_any(args.file, _unsaid(args))
    # Frames are the localizer's business: files of landmarks do not name one.
    return read_map_file(args.file, args.map_frame or "map", args.database), ""


def _unsaid(args: argparse.Namespace) -> Unsaid:
    defaults = Unsaid()
    try:
        kind = None if args.family is None else family(args.family)
    except ValueError as error:
        raise UsageError(f"--family: {error}") from error
    return Unsaid(kind, args.size, args.map_frame or defaults.map_frame, args.part or "")


def check_output(args: argparse.Namespace) -> None:
    """Refuse a name that says nothing, and to replace what is there."""
    suffix = args.out.suffix
    if suffix not in _OUTPUTS:
        raise UsageError(f"OUT must end in {' or '.join(_OUTPUTS)}, got {args.out}")
    if args.to is not None and (suffix == ".json") != (args.to == "wpilib"):
        raise UsageError(f"{args.to} is written to {'.json' if args.to == 'wpilib' else '.yaml'}")
    if args.to is not None and suffix == SUFFIX:
        raise UsageError("--to is for markers")
    refuse_existing(args)


def write(args: argparse.Namespace, any_map: Map | MarkerMap) -> None:
    """Write the map to OUT: markers as landmarks, their corners, with ids of ``detect``."""
    path: Path = args.out
    if isinstance(any_map, Map) and path.suffix != SUFFIX:
        raise UsageError(f"{args.file} holds landmarks, which go to {SUFFIX}")
    with atomic_files(path) as (part,):
        if isinstance(any_map, MarkerMap) and path.suffix in SUFFIXES:
            write_any(part, any_map, args.to or ("wpilib" if path.suffix == ".json" else OWN))
        else:
            landmarks = any_map
            if isinstance(landmarks, MarkerMap):  # corners, whose ids are rows of its points
                ids = np.arange(len(landmarks.points))
                landmarks = make_map(landmarks.points, ids, None, landmarks.map_frame)
            write_npz(part, landmarks)
    print(f"written to {path}")


def describe(file: Path, any_map: Map | MarkerMap, kind: str) -> dict[str, str]:
    """Print the table of a map, and return it."""
    rows = _of_markers(any_map, kind) if isinstance(any_map, MarkerMap) else _of_landmarks(any_map)
    for name, values in zip("xyz", any_map.points.T, strict=True):
        extent = f"{values.min():.3f} to {values.max():.3f}, median {np.median(values):.3f}"
        rows.append((f"{name} (m)", extent))
    print(file)
    for name, text in rows:
        print(f"  {name:40} {text}")
    return dict(rows)


def _of_landmarks(landmarks: Map) -> list[tuple[str, str]]:
    rows = [("landmarks", str(len(landmarks)))]
    if landmarks.dropped:
        rows.append(("left out (not finite, or not described)", str(landmarks.dropped)))
    ids, described = "none", "none"
    if landmarks.ids is not None:
        ids = f"{landmarks.ids.min()} to {landmarks.ids.max()}"
    if landmarks.descriptors is not None:
        width, of = landmarks.descriptors.shape[1], landmarks.descriptors.dtype
        measure = "Hamming" if of == np.uint8 else "L2"
        described = f"{width} x {of}, compared by {measure} distance"
    rows += [("ids", ids), ("descriptors", described)]
    if landmarks.covariances is not None:
        spread = np.sqrt(np.trace(landmarks.covariances, axis1=1, axis2=2))
        finite = spread[np.isfinite(spread)]
        middle = f"{1e3 * np.median(finite):.2f} mm (median)" if len(finite) else "none"
        rows.append(("deviations known", f"{len(finite)}, {middle}"))
    if landmarks.error_modes is not None:
        shared = np.sqrt(np.sum(landmarks.error_modes**2, axis=(1, 2)))
        rows.append(("deviations shared", f"{1e3 * np.median(shared):.2f} mm (median)"))
    return rows


def _of_markers(marker_map: MarkerMap, kind: str) -> list[tuple[str, str]]:
    rows = [("format", kind), ("map frame", marker_map.map_frame)]
    families = Counter(marker.family.name for marker in marker_map.markers)
    for name, count in sorted(families.items()):
        ids = sorted(marker.id for marker in marker_map.markers if marker.family.name == name)
        rows.append((f"markers of {name}", f"{count}, ids {ids[0]} to {ids[-1]}"))
    sizes = sorted({round(marker.size, 6) for marker in marker_map.markers})
    if sizes:
        rows.append(("sizes (m)", ", ".join(f"{size:g}" for size in sizes[:6])))
    deviations = [m.deviations for m in marker_map.markers if m.deviations is not None]
    if deviations:
        spread = np.linalg.norm(np.array(deviations)[:, :3], axis=1)
        rows.append(
            ("deviations known", f"{len(deviations)}, {1e3 * np.median(spread):.2f} mm (median)")
        )
    if marker_map.boards:
        rows.append(("boards", ", ".join(board.name for board in marker_map.boards)))
    return rows
