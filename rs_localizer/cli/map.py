"""``rs_localizer map``: what a map file holds, and other files of the same map."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from rs_localizer.cli import UsageError
from rs_localizer.io.maps.files import WRITERS, read_map_file
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.maps.ply import write_ply
from rs_localizer.io.whole import whole_files

_KINDS = "a .npz or .ply file or a folder of COLMAP"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    info = actions.add_parser("info", help="say what a map holds", allow_abbrev=False)
    convert = actions.add_parser("convert", help="write a map to another file", allow_abbrev=False)
    for action in (info, convert):
        action.add_argument("file", type=Path, metavar="FILE", help=_KINDS)
        action.add_argument(
            "--database",
            type=Path,
            metavar="FILE",
            help="COLMAP's, for the descriptors (default: database.db, or the only database of any "
            "name, in the folder or one of the two above)",
        )
    convert.add_argument("out", type=Path, metavar="OUT", help=" or ".join(WRITERS))
    convert.add_argument("--text", action="store_true", help="write .ply as text")
    convert.add_argument("--overwrite", action="store_true", help="replace OUT")


def run(args: argparse.Namespace) -> None:
    if args.action == "convert":
        _check_usage(args)
    # Frames are the localizer's business: files do not name one.
    landmarks = read_map_file(args.file, "map", args.database)
    _describe(args.file, landmarks)
    if args.action == "convert":
        with whole_files(args.out):
            if args.text:
                write_ply(args.out, landmarks, binary=False)
            else:
                WRITERS[args.out.suffix](args.out, landmarks)
        print(f"written to {args.out}")


def _check_usage(args: argparse.Namespace) -> None:
    if args.out.suffix not in WRITERS:
        raise UsageError(f"OUT must end in {' or '.join(WRITERS)}, got {args.out}")
    if args.text and args.out.suffix != ".ply":
        raise UsageError("--text goes with .ply")
    if args.out.exists() and not args.overwrite:
        raise ValueError(f"{args.out} exists; choose another OUT, or --overwrite")


def _describe(file: Path, landmarks: Map) -> None:
    rows = [("landmarks", str(len(landmarks)))]
    if landmarks.dropped:
        rows.append(("left out (not finite, or not described)", str(landmarks.dropped)))
    rows.append(("ids", _ids(landmarks)))
    rows.append(("descriptors", _descriptors(landmarks)))
    low, high = landmarks.points.min(axis=0), landmarks.points.max(axis=0)
    median = np.median(landmarks.points, axis=0)
    for name, *values in zip("xyz", low, median, high, strict=True):
        least, middle, most = (f"{value:.3f}" for value in values)
        rows.append((f"{name} (m)", f"{least} to {most}, median {middle}"))
    print(file)
    for name, text in rows:
        print(f"  {name:40} {text}")


def _ids(landmarks: Map) -> str:
    if landmarks.ids is None:
        return "none"
    return f"{landmarks.ids.min()} to {landmarks.ids.max()}"


def _descriptors(landmarks: Map) -> str:
    if landmarks.descriptors is None:
        return "none"
    width, kind = landmarks.descriptors.shape[1], landmarks.descriptors.dtype
    measure = "Hamming" if kind == np.uint8 else "L2"
    return f"{width} x {kind}, compared by {measure} distance"
