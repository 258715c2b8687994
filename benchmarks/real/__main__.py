# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.real FOLDER``: a table of real videos of boards.

``python -m benchmarks.real gyro RECORDING --gyroscope FILE``: turn rates before a gyroscope.

FOLDER holds videos and ``index.csv``, a line for each: file, inner corners, side of a square (m),
as ``walk.mp4,8x6,0.025``. Settings of the method as everywhere: ``-p map_deviation:=0.0005``.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.real import gyro, motion
from benchmarks.real.clips import clips_of, opencv_lens, shutter_of
from benchmarks.real.judging import METHODS, judged
from benchmarks.real.peers import PEERS
from benchmarks.real.recordings import add_settings
from rs_localizer.cli.settings_args import given_settings

Row = Mapping[str, float]
# What the text shows of the table, in parts.
_PARTS = {
    "localized images": (
        "images", *(f"{name}_localized" for name in (*PEERS, *METHODS)),
    ),
    "jitter over that of solvePnP": tuple(
        f"{name}_{what}"
        for name in (*METHODS, "poselib")
        for what in ("turn50", "turn95", "move50", "move95")
    ),
    "poses of the two sides of the board, at the same motion": (
        *(
            f"{name}_{what}"
            for name in METHODS[1:]
            for what in ("halves", "inside", "turn_claimed", "move_claimed")
        ),
    ),
    "held-out corners over solvePnP's": (
        "held_px", "single_held", "tracked_held", "reversed_held", "tracked_over_single",
    ),
    "readout, twists (deg/s), time": (
        "readout_ms",
        *(f"{name}_twist_{what}" for name in METHODS[1:] for what in ("size", "error", "inside")),
        *(f"{name}_ms" for name in METHODS),
    ),
}  # fmt: skip


JUDGES = {"gyro": gyro.main, "aria": motion.main}
"""Beside the boards, by the first argument."""


def main(argv: Sequence[str]) -> None:
    """Run it."""
    if argv and argv[0] in JUDGES:
        JUDGES[argv[0]](argv[1:])
        return
    parser = argparse.ArgumentParser(prog="python -m benchmarks.real", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("real"), help="table and text")
    parser.add_argument("--cache", type=Path, help="corners, calibrations (default: OUT/cache)")
    parser.add_argument("--images", type=int, default=300, help="most of each video")
    parser.add_argument("--only", nargs="*", default=[], help="names of videos without suffix")
    add_settings(parser)
    args = parser.parse_args(argv)
    cache = args.cache or args.out / "cache"
    config = given_settings(args)
    rows: dict[str, Row] = {}
    for clip in clips_of(args.folder, cache, args.images, args.only):
        shutter = shutter_of(clip, cache)
        if config.readout_time > 0.0:
            of_config = (config.readout_time, config.readout_time_deviation)
            shutter = replace(shutter, readout_time=of_config[0], deviation=of_config[1])
        print(f"{clip.name}: {len(clip.images)} images, calibrate: {shutter.verdict}", flush=True)
        rows[clip.name] = judged(clip, opencv_lens(clip), shutter, config)
        args.out.mkdir(parents=True, exist_ok=True)
        _write_csv(rows, args.out / "real.csv")
    text = _text(rows)
    print(text)
    (args.out / "real.txt").write_text(text + "\n", encoding="utf-8")


def _write_csv(rows: Mapping[str, Row], file: Path) -> None:
    columns = list(dict.fromkeys(name for row in rows.values() for name in row))
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, ["video", *columns], restval="")
        writer.writeheader()
        writer.writerows({"video": name, **row} for name, row in rows.items())


def _text(rows: Mapping[str, Row]) -> str:
    lines = []
    known = {column for columns in _PARTS.values() for column in columns}
    reasons = {x for row in rows.values() for x in row if x.startswith(METHODS) and x not in known}
    parts = {**_PARTS, "refused": tuple(sorted(reasons))}
    for title, columns in parts.items():
        lines += ["", title]
        width = max(map(len, columns), default=0) + 2
        lines.append(" " * width + "".join(f"{name:>9}" for name in rows))
        for column in columns:
            values = "".join(f"{_number(row.get(column)):>9}" for row in rows.values())
            lines.append(f"{column:{width}}{values}")
    return "\n".join(lines)


def _number(value: float | None) -> str:
    if value is None or math.isnan(value):
        return ""
    return f"{value:.0f}" if value == round(value) else f"{value:.3g}"


if __name__ == "__main__":
    main(sys.argv[1:])
