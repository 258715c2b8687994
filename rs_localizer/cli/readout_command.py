# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer readout``: published readout times of a camera."""

from __future__ import annotations

from dataclasses import dataclass

from rs_localizer.cli.options import argument
from rs_localizer.readout import COMMON, MEASURE, as_json, find_readout, known_cameras


@dataclass(frozen=True, kw_only=True)
class Options:
    name: str = argument('words of its name: "sony a7siii", imx219 (default: list all)', "NAME", "")
    mode: str = argument('words of its mode: "3840x2160 60"', "MODE", "")


def run(options: Options) -> list[dict[str, object]]:
    entries = find_readout(options.name, options.mode) if options.name else known_cameras()
    width = max(len(entry.name) for entry in entries)
    modes = max(len(entry.mode) for entry in entries)
    print(f"{'camera':{width}}  {'mode':{modes}}  median ms  quartiles ms   number  source")
    for entry in entries:
        spread = f"{1e3 * entry.low:.2f} to {1e3 * entry.high:.2f}"
        note = "; about the interval between images, rather an upper bound"
        print(
            f"{entry.name:{width}}  {entry.mode:{modes}}  {1e3 * entry.median:9.2f}  {spread:14} "
            f"{entry.number:6}  {entry.source}{note if entry.upper_bound else ''}"
        )
    print("Published values, perhaps of other modes: rs_localizer calibrate measures yours.")
    if not options.name:
        print(f"Not known of {', '.join(COMMON)}: {MEASURE}")
    return [as_json(entry) for entry in entries]
