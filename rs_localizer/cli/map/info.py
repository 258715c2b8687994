# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map info``: what a map file holds."""

from __future__ import annotations

import argparse

from rs_localizer.cli import WORKING
from rs_localizer.cli.map import either

if WORKING:
    from rs_localizer.markers.map_check import other_units
    from rs_localizer.markers.maps import MarkerMap


def add_arguments(parser: argparse.ArgumentParser) -> None:
    either.add_input(parser)


def run(args: argparse.Namespace) -> dict[str, str]:
    any_map, kind = either.read(args)
    table = either.describe(args.file, any_map, kind)
    if isinstance(any_map, MarkerMap) and (faults := list(other_units(any_map))):
        raise ValueError(f"{args.file}: {'; '.join(faults)}")
    return table
