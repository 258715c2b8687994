# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.real FOLDER``: a table of real videos of boards.

``python -m benchmarks.real gyro RECORDING --gyroscope FILE``: turn rates before a gyroscope.

FOLDER holds videos and ``index.csv``, a line for each: file, inner corners, side of a square (m),
as ``walk.mp4,8x6,0.025``. Settings of the method as everywhere: ``-p map_deviation:=0.0005``.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.experiments.results import Table
from benchmarks.real import gyro, motion
from benchmarks.real.clips import clips_of, opencv_lens, shutter_of
from benchmarks.real.judging import judged
from benchmarks.real.recordings import add_settings
from rs_localizer.cli.settings_args import given_settings

JUDGES = {"gyro": gyro.main, "aria": motion.main}
"""Beside the boards, by the first argument."""


def main(argv: Sequence[str]) -> None:
    """Run it."""
    if argv and argv[0] in JUDGES:
        JUDGES[argv[0]](argv[1:])
        return
    parser = argparse.ArgumentParser(prog="python -m benchmarks.real", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("real"), help="table")
    parser.add_argument("--cache", type=Path, help="corners, calibrations (default: OUT/cache)")
    parser.add_argument("--images", type=int, default=300, help="most of each video")
    parser.add_argument("--only", nargs="*", default=[], help="names of videos without suffix")
    add_settings(parser)
    args = parser.parse_args(argv)
    cache = args.cache or args.out / "cache"
    config = given_settings(args)
    rows: dict[str, dict[str, float]] = {}
    for clip in clips_of(args.folder, cache, args.images, args.only):
        shutter = shutter_of(clip, cache)
        if config.readout_time > 0.0:
            of_config = (config.readout_time, config.readout_time_deviation)
            shutter = replace(shutter, readout_time=of_config[0], deviation=of_config[1])
        print(f"{clip.name}: {len(clip.images)} images, calibrate: {shutter.verdict}", flush=True)
        rows[clip.name] = judged(clip, opencv_lens(clip), shutter, config)
        args.out.mkdir(parents=True, exist_ok=True)
        table(rows).write(args.out / "real.csv")  # who stops it keeps the videos that are done
    print(table(rows).text())


def table(rows: Mapping[str, Mapping[str, float]]) -> Table:
    """A column for each video, a line for each figure; reasons of refusals where there are some."""
    names = dict.fromkeys(name for row in rows.values() for name in row)
    figures = [(name, *(_number(row.get(name)) for row in rows.values())) for name in names]
    return Table(("figure", *rows), figures)


def _number(value: float | None) -> str:
    if value is None or math.isnan(value):
        return ""
    return f"{value:.0f}" if value == round(value) else f"{value:.3g}"


if __name__ == "__main__":
    main(sys.argv[1:])
