# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map info``: what a map file holds."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from rs_localizer.cli import WORKING
from rs_localizer.cli.map import either

if WORKING:
    import numpy as np

    from rs_localizer.core.arrays import Array
    from rs_localizer.io.maps.landmarks import Map
    from rs_localizer.markers.maps import MarkerMap


def add_arguments(parser: argparse.ArgumentParser) -> None:
    either.add_input(parser)


def run(args: argparse.Namespace) -> dict[str, str]:
    any_map, kind = either.read(args)
    return describe(args.file, any_map, kind)


def describe(file: Path, any_map: Map | MarkerMap, kind: str) -> dict[str, str]:
    """Print the table of a map, and return it."""
    rows = _of_markers(any_map, kind) if isinstance(any_map, MarkerMap) else _of_landmarks(any_map)
    rows += _extents(any_map.points)
    print(file)
    for name, text in rows:
        print(f"  {name:40} {text}")
    return dict(rows)


def _of_landmarks(landmarks: Map) -> list[tuple[str, str]]:
    rows = [("landmarks", str(len(landmarks)))]
    if landmarks.dropped:
        rows.append(("left out (not finite, or not described)", str(landmarks.dropped)))
    rows.append(("ids", _ids(landmarks)))
    rows.append(("descriptors", _descriptors(landmarks)))
    if landmarks.covariances is not None:
        spread = np.sqrt(np.trace(landmarks.covariances, axis1=1, axis2=2))
        finite = spread[np.isfinite(spread)]
        middle = f"{1e3 * np.median(finite):.2f} mm (median)" if len(finite) else "none"
        rows.append(("deviations known", f"{len(finite)}, {middle}"))
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


def _extents(points: Array) -> list[tuple[str, str]]:
    rows = []
    low, high, median = points.min(axis=0), points.max(axis=0), np.median(points, axis=0)
    for name, *values in zip("xyz", low, median, high, strict=True):
        least, middle, most = (f"{value:.3f}" for value in values)
        rows.append((f"{name} (m)", f"{least} to {most}, median {middle}"))
    return rows


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
