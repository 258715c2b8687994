"""``rs_localizer map info``: what a map file holds."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from rs_localizer.io.maps.files import read_map_file
from rs_localizer.io.maps.landmarks import Map

_KINDS = "a .npz or .ply file or a folder of COLMAP"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help=_KINDS)
    parser.add_argument(
        "--database",
        type=Path,
        metavar="FILE",
        help="COLMAP's, for the descriptors (default: database.db, or the only database of any "
        "name, in the folder or one of the two above)",
    )


def run(args: argparse.Namespace) -> None:
    read_and_describe(args)


def read_and_describe(args: argparse.Namespace) -> Map:
    """The map that the arguments name; its table is printed."""
    # Frames are the localizer's business: files do not name one.
    landmarks = read_map_file(args.file, "map", args.database)
    _describe(args.file, landmarks)
    return landmarks


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
