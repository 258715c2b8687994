# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.real FOLDER``: real videos of boards, together; each in OUT/real.csv.

``python -m benchmarks real gyro BAG``: turn rates before a gyroscope, of your own recording.

FOLDER holds videos and ``index.csv``, a line for each: file, inner corners, side of a square (m),
as ``walk.mp4,8x6,0.025``. Settings of the method as everywhere: ``-p map_deviation:=0.0005``.
"""

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

from benchmarks.experiments.results import Table, rounded
from benchmarks.real import gyro
from benchmarks.real.clips import clips_of, opencv_lens, shutter_of
from benchmarks.real.judging import METHODS, judged
from benchmarks.real.peers import PEERS
from benchmarks.real.recordings import add_settings
from rs_localizer.cli.recording_input import given_settings


def main(argv: Sequence[str]) -> int:
    """Run it; the exit code: 0 done, 1 the recording cannot be used, 2 wrong usage."""
    try:
        if argv and argv[0] == "gyro":
            gyro.main(argv[1:])
        else:
            boards(argv)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"python -m benchmarks real: {error}\n")
        return 1
    return 0


def boards(argv: Sequence[str]) -> None:
    """Videos of boards, together."""
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
        said = f"{clip.name}: {len(clip.images)} images, calibrate: {shutter.verdict}"
        print(said, file=sys.stderr, flush=True)
        rows[clip.name] = judged(clip, opencv_lens(clip), shutter, config)
        args.out.mkdir(parents=True, exist_ok=True)
        table(rows).write(args.out / "real.csv")  # who stops it keeps the videos that are done
    print(together(rows).text())


_FIGURES = {
    "jitter, median": "turn50", "jitter, 95 %": "turn95", "sides inside, %": "inside",
    "claimed / actual": "turn_claimed", "held-out corners": "held",
    "twists inside, %": "twist_inside", "ms": "ms",
}  # fmt: skip


def together(rows: Mapping[str, Mapping[str, float]]) -> Table:
    """Medians of all videos, and their extremes, of each method."""
    names = (*METHODS, *PEERS)

    def cell(name: str, figure: str) -> str:
        scale = 100.0 if figure.endswith("inside") else 1.0
        values = [scale * row.get(f"{name}_{figure}", math.nan) for row in rows.values()]
        known = [value for value in values if not math.isnan(value)]
        if not known:
            return ""
        return f"{median(known):.3g} ({rounded(min(known))}-{rounded(max(known))})"

    localized = [f"{sum(row[f'{name}_localized'] for row in rows.values()):.0f}" for name in names]
    figures = [(head, *(cell(name, of) for name in names)) for head, of in _FIGURES.items()]
    images = sum(row["images"] for row in rows.values())
    return Table((f"{images:.0f} images", *names), [("localized", *localized), *figures])


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
    sys.exit(main(sys.argv[1:]))
