# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Ours beside P3P where a rolling shutter may be imagined, condition by condition:

python -m benchmarks.honesty --only board 0.1px --frames 100

The default against a global shutter, frame by frame, where maps and lenses are a little off and the
readout time is short, zero or not known.
"""

from __future__ import annotations

import argparse
import csv
import re
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.frames.judged import REGION
from benchmarks.honesty.estimating import believed, estimate, frames_of, scored
from benchmarks.honesty.scores import Scores, percent
from benchmarks.independent.cameras import Camera
from benchmarks.independent.motions import hand
from benchmarks.independent.scenes import Board
from rs_localizer.cli.options import integer
from rs_localizer.config import LocalizerConfig
from rs_localizer.localizer import Localizer

Row = tuple[str | float | int, ...]

_NOISES = (0.1, 0.5)  # px
_READOUTS = (0.0, 0.005, 0.011, 0.03)  # s
# Share of the distortion that the calibration lacks, and bend (m) that the map does not know.
_FAULTS = ((0.0, 0.0), (0.1, 0.0), (0.3, 0.0), (0.0, 2e-4), (0.0, 5e-4), (0.0, 2e-3), (0.1, 5e-4))
# 12 deg/s, as one who films a board.
_FILMING = partial(hand, slower=67.0 / 12.0)
# A user who sets a readout time for a global shutter.
_WRONG_READOUT = 0.02

_COLUMNS = (
    "condition", "frames", "deg", "deg_p3p", "ratio", "deg_95", "deg_95_p3p", "ratio_95",
    "mm", "mm_p3p", "mm_95", "mm_95_p3p", "insignificant", "refused", "refused_p3p", "reasons",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Condition:
    """A target, what is wrong with it and the lens, and what the user says of the shutter.

    ``told``: ``unset`` (the readout time is 0), ``set`` (single frames) or ``tracked``. A global
    shutter (readout 0) that is ``set`` has a wrong readout time of 20 ms.
    """

    markers: bool
    distortion_off: float
    bend: float
    noise: float
    readout: float
    told: str

    @property
    def name(self) -> str:
        target = "markers" if self.markers else "board"
        faults = f"lens {100 * self.distortion_off:g}% bend {1e3 * self.bend:g}mm"
        return f"{target}/{faults}/{self.noise:g}px/{1e3 * self.readout:g}ms/{self.told}"


def _conditions() -> Sequence[Condition]:
    return [
        Condition(markers, *fault, noise, readout, told)
        for markers, fault, noise, readout in product((False, True), _FAULTS, _NOISES, _READOUTS)
        for told in (("unset", "set", "tracked") if readout > 0.0 else ("unset", "set"))
    ]


def _row(condition: Condition, frames: int, seed: int) -> Row:
    """Errors of the frames that both localize, at the middle row; shares in %."""
    tracking = condition.told == "tracked"
    ours = _scores(condition, LocalizerConfig().solver, tracking, frames, seed)
    theirs = _of_p3p(replace(condition, told="unset"), frames, seed)
    both = ours.localized & theirs.localized
    figures: list[float] = []
    for column, factor in (("orientation", 1.0), ("position", 1e3)):
        for quantile in (0.5, 0.95):
            pair = [factor * _quantile(one.of(column)[both], quantile) for one in (ours, theirs)]
            figures += [*pair, pair[0] / pair[1]] if column == "orientation" else pair
    return (
        condition.name,
        len(ours),
        *figures,
        percent(ours.of("moving")[ours.localized] < REGION),
        100.0 * ours.refused,
        100.0 * theirs.refused,
        ours.reasons(),
    )


@lru_cache(maxsize=1)
def _of_p3p(condition: Condition, frames: int, seed: int) -> Scores:
    """Which does not care what it is told of the readout time."""
    return _scores(condition, "p3p", False, frames, seed)


def _scores(condition: Condition, solver: str, tracking: bool, frames: int, seed: int) -> Scores:
    true = Camera(readout_time=condition.readout)
    scene = Board(condition.markers, condition.bend)
    seen = frames_of(true, _FILMING, scene, frames, seed)
    set_to = 0.0 if condition.told == "unset" else condition.readout or _WRONG_READOUT
    camera = believed(true, set_to, condition.distortion_off)
    results = estimate(seen, Localizer(camera, solver=solver), condition.noise, tracking)
    return scored(seen, results, camera).middle


def _quantile(values: np.ndarray, at: float) -> float:
    return float(np.quantile(values, at)) if len(values) else np.nan


def matching(names: Sequence[str], words: Sequence[str]) -> list[str]:
    """Names in which each of these begins a word: ``3px`` is not ``0.3px``."""
    patterns = [re.compile(rf"(^|[/ ]){re.escape(word)}") for word in words]
    return [name for name in names if all(pattern.search(name) for pattern in patterns)]


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.honesty",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD",
        help="conditions with all of these words in their names, such as: board 0.1px 5ms unset",
    )  # fmt: skip
    parser.add_argument(
        "--frames", type=integer(1), default=100, metavar="N",
        help="of each condition (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--seed", type=integer(0), default=0, metavar="N")
    parser.add_argument("--csv", type=Path, metavar="DIR", help="write the table there, too")
    options = parser.parse_args()
    conditions = {condition.name: condition for condition in _conditions()}
    chosen = matching(list(conditions), options.only)
    if not chosen:
        names = ", ".join(list(conditions)[:4])
        sys.stderr.write(f"no condition has {options.only} in its name, as {names} have\n")
        return 2
    start = time.perf_counter()
    rows: list[Row] = [_COLUMNS]
    width = max(map(len, chosen))
    print("".join(_cells(_COLUMNS, width)))
    for one in chosen:
        rows.append(_row(conditions[one], options.frames, options.seed))
        print("".join(_cells(rows[-1], width)), flush=True)
    print(f"{time.perf_counter() - start:.0f} s")
    if options.csv is not None:
        options.csv.mkdir(parents=True, exist_ok=True)
        with (options.csv / "p3p.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(rows)
    return 0


def _cells(row: Row, width: int) -> Iterator[str]:
    yield f"{row[0]:{width}}"
    for name, value in zip(_COLUMNS[1:], row[1:], strict=True):
        text = f"{value:.3g}" if isinstance(value, float) else str(value)
        yield f"  {text}" if name == "reasons" else f"{text:>{max(9, len(name) + 1)}}"


if __name__ == "__main__":
    sys.exit(main())
