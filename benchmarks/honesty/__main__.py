# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Single benches, or single conditions of them, for who works on the estimator:

python -m benchmarks.honesty p3p --only board 0.1px --frames 100
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

from benchmarks.honesty.benches import Bench, benches, heading, line
from rs_localizer.cli.options import integer

_NAMES = ("p3p", "tags", "rendered")


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.honesty",
        description="How honest the estimates are, condition by condition.",
    )
    parser.add_argument("names", nargs="+", metavar="BENCH", choices=_NAMES, help=", ".join(_NAMES))
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD",
        help="conditions with all of these words in their names, such as: board 0.1px 5ms unset",
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
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = benches(options.cache or Path(folder))
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
    return 0


if __name__ == "__main__":
    sys.exit(main())
