# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Maps of landmarks or of markers: what all actions on files of maps take, write and describe."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rs_localizer.cli import WORKING, refuse_existing
from rs_localizer.cli.options import UsageError, argument, option
from rs_localizer.io.maps.files import SUFFIX, read_map_file
from rs_localizer.io.recording import MAP_FRAME
from rs_localizer.markers.map_files import (
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

    from rs_localizer.core.arrays import Array
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
Figures = dict[str, Any]
"""What ``--json`` prints: identifiers, with their units."""


@dataclass(frozen=True, kw_only=True)
class MapFileOptions:
    """markers: what files of other programs omit."""

    file: Path = argument(_KINDS, "FILE")
    family: str | None = option(f"(default: that of the file, or {USUAL_FAMILY.name})", "NAME")
    size: float | None = option("of all markers", "M", limits=(0.0, math.inf), above=True)
    part: str = option("of several bundles", "NAME", "")


@dataclass(frozen=True, kw_only=True)
class OtherFileOptions(MapFileOptions):
    """what is written."""

    out: Path = argument(f"ends in {', '.join(_OUTPUTS)}", "OUT")
    to: str | None = option(
        "of markers (default: .json is of wpilib, .yaml our own)", choices=list(FORMATS)
    )
    overwrite: bool = option("replace OUT", default=False)


def read(options: MapFileOptions) -> tuple[Map | MarkerMap, str]:
    """The map that the options name, and the name of its format, empty for landmarks."""
    if is_marker_file(options.file):
        return read_any(options.file, _unsaid(options))
    # Frames are the localizer's business: files of landmarks do not name one.
    return read_map_file(options.file, MAP_FRAME), ""


def _unsaid(options: MapFileOptions) -> Unsaid:
    try:
        kind = None if options.family is None else family(options.family)
    except ValueError as error:
        raise UsageError(f"--family: {error}") from error
    return Unsaid(kind, options.size, part=options.part)


def check_output(options: OtherFileOptions) -> None:
    """Refuse a name that says nothing, and to replace what is there."""
    suffix = options.out.suffix
    if suffix not in _OUTPUTS:
        raise UsageError(f"OUT must end in {' or '.join(_OUTPUTS)}, got {options.out}")
    if options.to is not None and (suffix == ".json") != (options.to == "wpilib"):
        raise UsageError(
            f"{options.to} is written to {'.json' if options.to == 'wpilib' else '.yaml'}"
        )
    if options.to is not None and suffix == SUFFIX:
        raise UsageError("--to is for markers")
    refuse_existing(options)


def write(options: OtherFileOptions, any_map: Map | MarkerMap) -> None:
    """Write the map to OUT: markers as landmarks, their corners, with ids of ``detect``."""
    path: Path = options.out
    if isinstance(any_map, Map) and path.suffix != SUFFIX:
        raise UsageError(f"{options.file} holds landmarks, which go to {SUFFIX}")
    with atomic_files(path) as (part,):
        if isinstance(any_map, MarkerMap) and path.suffix in SUFFIXES:
            write_any(part, any_map, options.to or ("wpilib" if path.suffix == ".json" else OWN))
        else:
            landmarks = any_map
            if isinstance(landmarks, MarkerMap):  # corners, whose ids are rows of its points
                ids = np.arange(len(landmarks.points))
                landmarks = make_map(landmarks.points, ids, None, landmarks.map_frame)
            write_npz(part, landmarks)
    print(f"written to {path}")


def describe(file: Path, any_map: Map | MarkerMap, kind: str) -> Figures:
    """Print the table of a map, and return its figures."""
    figures: Figures = {"format": kind} if kind else {}
    if isinstance(any_map, MarkerMap):
        rows = _of_markers(any_map, figures)
    else:
        rows = _of_landmarks(any_map, figures)
    for name, values in zip("xyz", any_map.points.T, strict=True):
        low, middle, high = (float(f(values)) for f in (np.min, np.median, np.max))
        rows.append((f"{name} (m)", f"{low:.3f} to {high:.3f}, median {middle:.3f}"))
        figures |= {f"{name}_min_m": low, f"{name}_median_m": middle, f"{name}_max_m": high}
    print(file)
    for name, text in [("format", kind), *rows] if kind else rows:
        print(f"  {name:40} {text}")
    return figures


def _of_landmarks(landmarks: Map, figures: Figures) -> list[tuple[str, str]]:
    rows = [("landmarks", str(len(landmarks)))]
    figures |= {"landmarks": len(landmarks), "left_out": landmarks.dropped}
    if landmarks.dropped:
        rows.append(("left out (not finite, or not described)", str(landmarks.dropped)))
    ids, described = "none", "none"
    if landmarks.ids is not None:
        ids = f"{landmarks.ids.min()} to {landmarks.ids.max()}"
        figures |= {"first_id": int(landmarks.ids.min()), "last_id": int(landmarks.ids.max())}
    if landmarks.descriptors is not None:
        width, of = landmarks.descriptors.shape[1], landmarks.descriptors.dtype
        measure = "Hamming" if of == np.uint8 else "L2"
        described = f"{width} x {of}, compared by {measure} distance"
        figures |= {"descriptor_length": width, "descriptor_type": str(of)}
    rows += [("ids", ids), ("descriptors", described)]
    if landmarks.covariances is not None:
        spread = np.sqrt(np.trace(landmarks.covariances, axis1=1, axis2=2))
        rows.append(_deviations(spread[np.isfinite(spread)], figures))
    if landmarks.error_modes is not None:
        shared = 1e3 * float(np.median(np.sqrt(np.sum(landmarks.error_modes**2, axis=(1, 2)))))
        figures["shared_deviation_median_mm"] = shared
        rows.append(("deviations shared", f"{shared:.2f} mm (median)"))
    return rows


def _of_markers(marker_map: MarkerMap, figures: Figures) -> list[tuple[str, str]]:
    rows = [("map frame", marker_map.map_frame)]
    figures |= {"map_frame": marker_map.map_frame, "markers": len(marker_map.markers)}
    families = Counter(marker.family.name for marker in marker_map.markers)
    for name, count in sorted(families.items()):
        ids = sorted(marker.id for marker in marker_map.markers if marker.family.name == name)
        rows.append((f"markers of {name}", f"{count}, ids {ids[0]} to {ids[-1]}"))
        figures[f"ids_{name}"] = ids
    sizes = sorted({round(marker.size, 6) for marker in marker_map.markers})
    if sizes:
        rows.append(("sizes (m)", ", ".join(f"{size:g}" for size in sizes[:6])))
        figures["sizes_m"] = sizes
    deviations = [m.deviations for m in marker_map.markers if m.deviations is not None]
    if deviations:
        rows.append(_deviations(np.linalg.norm(np.array(deviations)[:, :3], axis=1), figures))
    if marker_map.boards:
        rows.append(("boards", ", ".join(board.name for board in marker_map.boards)))
        figures["boards"] = [board.name for board in marker_map.boards]
    return rows


def _deviations(known: Array, figures: Figures) -> tuple[str, str]:
    """The row of deviations (n,) m that are known."""
    middle = 1e3 * float(np.median(known)) if len(known) else None
    figures |= {"deviations": len(known), "deviation_median_mm": middle}
    text = "none" if middle is None else f"{middle:.2f} mm (median)"
    return "deviations known", f"{len(known)}, {text}"
