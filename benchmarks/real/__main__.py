# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.real FOLDER``: a table and a picture of real videos of boards.

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

import matplotlib as mpl
import numpy as np

from benchmarks.real import gyro, mocap, motion, solvers
from benchmarks.real.calibrations import report
from benchmarks.real.clips import clips_of, opencv_lens, shutter_of
from benchmarks.real.judging import METHODS, judged
from benchmarks.real.options import add_settings, settings_of
from benchmarks.real.peers import PEERS

mpl.use("Agg")
from matplotlib import pyplot as plt

Row = Mapping[str, float]
# What the text shows of the table, in parts.
_PARTS = {
    "localized images": (
        "images", *(f"{name}_localized" for name in (*PEERS, *METHODS)),
    ),
    "jitter over that of solvePnP": tuple(
        f"{name}_{what}"
        for name in (*METHODS, "poselib")
        for what in (
            *("turn50", "turn50_low", "turn50_high", "turn95", "turn95_low", "turn95_high"),
            *("move50", "move95"),
        )
    ),
    "poses of the two sides of the board, at the same motion": (
        *(
            f"{name}_{what}"
            for name in METHODS[1:]
            for what in ("halves", "inside", "turn_claimed", "move_claimed")
        ),
        "random_turn_claimed",
    ),
    "held-out corners over solvePnP's": (
        "held_px",
        "single_held", "single_held_low", "single_held_high",
        "tracked_held", "tracked_held_low", "tracked_held_high",
        "reversed_held", "reversed_held_low", "reversed_held_high",
        "tracked_over_single",
    ),
    "held-out corners, one motion through all images, over a global shutter": (
        "found_ms", "motion_held", "motion_held_low", "motion_held_high",
        "backward_held", "backward_held_low", "backward_held_high",
    ),
    "readout, twists (deg/s), time": (
        "readout_ms",
        *(f"{name}_twist_{what}" for name in METHODS[1:] for what in ("size", "error", "inside")),
        *(f"{name}_ms" for name in METHODS),
    ),
}  # fmt: skip


JUDGES = {
    "gyro": gyro.main, "solvers": solvers.main, "aria": motion.main, "mocap": mocap.main
}  # fmt: skip
"""Beside the boards, by the first argument."""


def main(argv: Sequence[str]) -> None:
    """Run it."""
    if argv and argv[0] in JUDGES:
        JUDGES[argv[0]](argv[1:])
        return
    parser = argparse.ArgumentParser(prog="python -m benchmarks.real", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("real"), help="table, text and picture")
    parser.add_argument("--cache", type=Path, help="corners, calibrations (default: OUT/cache)")
    parser.add_argument("--images", type=int, default=300, help="most of each video")
    parser.add_argument("--only", nargs="*", default=[], help="names of videos without suffix")
    parser.add_argument(
        "--calibrations", action="store_true", help="calibrate's halves and thirds instead"
    )
    add_settings(parser)
    args = parser.parse_args(argv)
    cache = args.cache or args.out / "cache"
    config = settings_of(args)
    if args.calibrations:
        text = report(clips_of(args.folder, cache, args.images, args.only), cache)
        args.out.mkdir(parents=True, exist_ok=True)
        print(text)
        (args.out / "calibrations.txt").write_text(text + "\n", encoding="utf-8")
        return
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
    _draw(rows, args.out / "real.png")


def _write_csv(rows: Mapping[str, Row], file: Path) -> None:
    columns = list(dict.fromkeys(name for row in rows.values() for name in row))
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, ["video", *columns], restval="")
        writer.writeheader()
        writer.writerows({"video": name, **row} for name, row in rows.items())


def _text(rows: Mapping[str, Row]) -> str:
    lines = []
    for title, columns in _PARTS.items():
        lines += ["", title]
        width = max(map(len, columns)) + 2
        lines.append(" " * width + "".join(f"{name:>9}" for name in rows))
        for column in columns:
            values = "".join(f"{_number(row.get(column)):>9}" for row in rows.values())
            lines.append(f"{column:{width}}{values}")
    reasons = sorted(
        {x for row in rows.values() for x in row if x.startswith(METHODS) and _is_reason(x)}
    )
    lines += ["", "refused"]
    for reason in reasons:
        lines.append(
            f"{reason:28}" + "".join(f"{_number(row.get(reason)):>9}" for row in rows.values())
        )
    return "\n".join(lines)


def _is_reason(name: str) -> bool:
    known = {column for columns in _PARTS.values() for column in columns}
    return name not in known


def _number(value: float | None) -> str:
    if value is None or math.isnan(value):
        return ""
    return f"{value:.0f}" if value == round(value) else f"{value:.3g}"


def _draw(rows: Mapping[str, Row], file: Path) -> None:
    """Localized, jitter, halves, held-out corners: the line at 1 is solvePnP, or the claim."""
    panels = {
        "localized / solvePnP": [f"{name}_localized" for name in METHODS],
        "jitter of orientation / solvePnP, median": [f"{name}_turn50" for name in METHODS],
        "inside 95 % regions": ["single_inside", "tracked_inside"],
        "held-out corners / global shutter": ["motion_held", "tracked_held", "backward_held"],
    }
    figure, axes = plt.subplots(2, 2, figsize=(11, 7), layout="constrained")
    places = np.arange(len(rows))
    for panel, (title, columns) in zip(axes.flat, panels.items(), strict=True):
        for k, column in enumerate(columns):
            scale = "solvepnp_localized" if title.startswith("localized") else None
            values = [
                row.get(column, np.nan) / (max(row[scale], 1.0) if scale else 1.0)
                for row in rows.values()
            ]
            panel.bar(places + 0.27 * (k - 1), values, 0.25, label=column.split("_")[0])
        panel.axhline(0.95 if title.startswith("inside") else 1.0, color="black", linewidth=0.8)
        panel.set_title(title)
        panel.set_xticks(places, list(rows))
        panel.legend(fontsize="small")
    figure.savefig(file, dpi=100)


if __name__ == "__main__":
    main(sys.argv[1:])
