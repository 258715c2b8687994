# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map info``: what a map file holds."""

from __future__ import annotations

from dataclasses import dataclass

from rs_localizer.cli import WORKING
from rs_localizer.cli.map import either

if WORKING:
    from rs_localizer.markers.map_check import other_units
    from rs_localizer.markers.maps import MarkerMap


@dataclass(frozen=True, kw_only=True)
class Options(either.MapFileOptions):
    pass


def run(options: Options) -> either.Figures:
    any_map, kind = either.read(options)
    table = either.describe(options.file, any_map, kind)
    if isinstance(any_map, MarkerMap) and (faults := list(other_units(any_map))):
        raise ValueError(f"{options.file}: {'; '.join(faults)}")
    return table
