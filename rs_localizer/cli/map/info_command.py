# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map info``: describe a map file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.cli.options import argument
from rs_localizer.io.maps.files import read_map_file
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.recording import MAP_FRAME
from rs_localizer.markers.map_files import FORMATS, is_marker_file, read_any
from rs_localizer.markers.maps import MarkerMap

Figures = dict[str, Any]
"""Printed figures, and those of ``--json``: identifiers, with their units."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """the map."""

    file: Path = argument(
        "landmarks: a .npz file or a folder of COLMAP; markers: a .yaml or .json file of "
        f"{', '.join(FORMATS)}", "FILE",
    )  # fmt: skip


def run(options: Options) -> Figures:
    any_map, kind = read(options)
    return describe(options.file, any_map, kind)


def read(options: Options) -> tuple[Map | MarkerMap, str]:
    """Read the map that the options name; return it with the name of its format."""
    if not is_marker_file(options.file):
        # Frames are the localizer's business: files of landmarks do not name one.
        return read_map_file(options.file, MAP_FRAME), "landmarks"
    return read_any(options.file)


def describe(file: Path, any_map: Map | MarkerMap, kind: str) -> Figures:
    """Print the content of a map, and return it."""
    figures: Figures = {"format": kind}
    if isinstance(any_map, MarkerMap):
        figures |= {"map_frame": any_map.map_frame, "markers": len(any_map.markers)}
        for name in sorted({marker.family.name for marker in any_map.markers}):
            ids = sorted(marker.id for marker in any_map.markers if marker.family.name == name)
            figures |= {f"ids_{name}": ids}
        figures["sizes_m"] = sorted({round(marker.size, 6) for marker in any_map.markers})
        figures["boards"] = [board.name for board in any_map.boards]
        known = [one.deviations for one in any_map.markers if one.deviations is not None]
        deviations = np.linalg.norm(np.array(known).reshape(-1, 6)[:, :3], axis=1)
    else:
        figures |= {"landmarks": len(any_map), "left_out_not_finite": any_map.dropped}
        if any_map.ids is not None:
            figures |= {"first_id": int(any_map.ids.min()), "last_id": int(any_map.ids.max())}
        if any_map.descriptors is not None:
            figures["descriptor_length"] = any_map.descriptors.shape[1]
            figures["descriptor_type"] = str(any_map.descriptors.dtype)
        if any_map.error_modes is not None:
            shared = np.sqrt(np.sum(any_map.error_modes**2, axis=(1, 2)))
            figures["shared_deviation_median_mm"] = 1e3 * float(np.median(shared))
        covariances = np.zeros((0, 3, 3)) if any_map.covariances is None else any_map.covariances
        deviations = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
        deviations = deviations[np.isfinite(deviations)]
    figures["deviations"] = len(deviations)
    if len(deviations):
        figures["deviation_median_mm"] = 1e3 * float(np.median(deviations))
    for name, values in zip("xyz", any_map.points.T, strict=True):
        for what, of in (("min", np.min), ("median", np.median), ("max", np.max)):
            figures[f"{name}_{what}_m"] = float(of(values))
    print(file)
    for name, value in figures.items():
        print(f"  {name:28} {f'{value:.3f}' if isinstance(value, float) else value}")
    return figures
