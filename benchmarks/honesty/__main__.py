"""Single benches, or single conditions of them, for who works on the estimator:

python -m benchmarks.honesty coverage --only hand rich --frames 100
python -m benchmarks.honesty rendered --cache ~/rendered
"""

from __future__ import annotations

import argparse
import csv
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.data import GLOBAL_SHUTTER_TAGS, SLOW_HAND_MOTION
from benchmarks.experiments.results import Table
from benchmarks.honesty.benches import Bench, Recordings, benches
from benchmarks.honesty.picture import Shares, picture, shares_at_stamp
from benchmarks.honesty.text import heading, line
from rs_localizer import data
from rs_localizer.process.arguments import integer

_NAMES = ("coverage", "p3p", "vibration", "few", "many", "lens", "planes", "tags", "rendered")


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.honesty",
        description="How honest the estimates are, condition by condition.",
    )
    parser.add_argument("names", nargs="+", metavar="BENCH", choices=_NAMES, help=", ".join(_NAMES))
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD",
        help="conditions with all of these words in their names, such as: hand rich 0.05px tracked",
    )  # fmt: skip
    parser.add_argument(
        "--frames", type=integer(1), default=100, metavar="N",
        help="of each condition (default: %(default)s); recordings are cut in proportion below 100",
    )  # fmt: skip
    parser.add_argument("--seed", type=integer(0), default=0, metavar="N")
    parser.add_argument(
        "--cache", type=Path, metavar="DIR",
        help="where corners detected in rendered images are kept (default: nowhere)",
    )  # fmt: skip
    parser.add_argument("--csv", type=Path, metavar="DIR", help="write the tables there, too")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the coverage")
    parser.add_argument(
        "--before", type=Path, metavar="FILE",
        help="coverage.csv of another version, which --picture shows beside this one",
    )  # fmt: skip
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        recordings = Recordings(
            GLOBAL_SHUTTER_TAGS,
            {
                "tum_vi_room5": data.path(data.HAND_MOTION),
                "tum_rgbd_fr1_xyz": SLOW_HAND_MOTION,
            },
            options.cache or Path(folder),
        )
        found = benches(recordings)
        return max(_run(name, found[name], options) for name in options.names)


def _run(name: str, bench: Bench[Any, Any], options: argparse.Namespace) -> int:
    conditions = bench.matching(options.only)
    if not conditions:
        names = ", ".join(condition.name for condition in bench.conditions[:4])
        sys.stderr.write(f"{name}: no condition has {options.only} in its name, as {names} have\n")
        return 2
    start, rows = time.perf_counter(), []
    width = max(len(condition.name) for condition in conditions)
    sys.stdout.write(f"{bench.title}\n{heading(bench.columns, width)}\n")
    for condition, result in bench.run(conditions, options.frames, options.seed):
        rows.append(bench.row(condition, result))
        sys.stdout.write(f"{line(bench.columns, rows[-1], width)}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{time.perf_counter() - start:.0f} s\n")
    if options.csv is not None:
        options.csv.mkdir(parents=True, exist_ok=True)
        with (options.csv / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([bench.columns, *rows])
    if name == "coverage" and options.picture is not None:
        before = None if options.before is None else _shares(_read(options.before))
        picture(_shares(Table(bench.columns, rows)), before).savefig(options.picture)
    return 0


def _shares(table: Table) -> dict[str, Shares]:
    return {part: shares_at_stamp(table, part) for part in ("pose", "twist")}


def _read(path: Path) -> Table:
    with path.open(newline="", encoding="utf-8") as file:
        columns, *rows = csv.reader(file)
    return Table(tuple(columns), rows)


if __name__ == "__main__":
    sys.exit(main())
