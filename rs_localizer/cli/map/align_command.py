# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map align``: scale, direction of gravity and origin of a map; its own format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.cli import refuse_existing, write_all
from rs_localizer.cli.map import info_command
from rs_localizer.cli.options import ResultOptions, UsageError, argument, option
from rs_localizer.io.maps.files import SUFFIX, write_npz
from rs_localizer.io.maps.landmarks import Map, make_map
from rs_localizer.markers.map_files import write_marker_map
from rs_localizer.tools.mapping.gauge import alignment, moved_map

_OUTPUTS = (SUFFIX, ".yaml", ".yml")


@dataclass(frozen=True, kw_only=True)
class Options(info_command.Options, ResultOptions):
    out: Path = argument(f"ends in {', '.join(_OUTPUTS)}", "OUT")
    scale: float | None = option("factor", "FACTOR", above=0.0)
    distance: tuple[float, float, float] | None = option(
        "instead: two ids (of landmarks, or of markers, whose middles count), and how far apart "
        "they are", "ID ID M",
    )  # fmt: skip
    up: tuple[float, float, float] | None = option("z of the new map, in the map as it is", "X Y Z")
    origin: int | None = option("id at the origin", "ID")


def run(options: Options) -> info_command.Figures:
    suffix = options.out.suffix
    if suffix not in _OUTPUTS:
        raise UsageError(f"OUT must end in {' or '.join(_OUTPUTS)}, got {options.out}")
    if options.scale and options.distance:
        raise UsageError("give one of --scale, --distance")
    refuse_existing(options)
    any_map, kind = info_command.read(options)
    if isinstance(any_map, Map) and suffix != SUFFIX:
        raise UsageError(f"{options.file} holds landmarks, which go to {SUFFIX}")
    wishes = (options.scale, options.distance, options.up, options.origin)
    if wishes != (None,) * 4:
        by = alignment(any_map, *wishes)
        turn = np.degrees(Rotation.from_matrix(by.rotation).magnitude())
        shift = ", ".join(f"{value:.4f}" for value in by.translation)
        print(f"scaled by {by.scale:.6g}, rotated by {turn:.3f} deg, shifted by ({shift}) m")
        any_map = moved_map(any_map, by)
    figures = info_command.describe(options.file, any_map, kind)

    def write(part: Path) -> None:
        if isinstance(any_map, Map):
            write_npz(part, any_map)
        elif suffix != SUFFIX:
            write_marker_map(part, any_map)
        else:  # corners, with ids of ``detect``: rows of its points
            ids = np.arange(len(any_map.points))
            write_npz(part, make_map(any_map.points, ids, None, any_map.map_frame))

    write_all({options.out: write})
    return {**figures, "written_to": str(options.out)}
