# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Ours beside P3P where a rolling shutter may be imagined, condition by condition:

python -m benchmarks.honesty p3p --only board 0.1px --frames 100
python -m benchmarks.honesty tags
"""

from __future__ import annotations

import argparse
import csv
import re
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.honesty import against_p3p, tags
from rs_localizer.cli.options import integer

_BENCHES = {"p3p": against_p3p, "tags": tags}


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
        "names", nargs="+", metavar="BENCH", choices=_BENCHES, help=", ".join(_BENCHES)
    )
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD",
        help="conditions with all of these words in their names, such as: board 0.1px 5ms unset",
    )  # fmt: skip
    parser.add_argument(
        "--frames", type=integer(1), default=100, metavar="N",
        help="of each condition of p3p (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--seed", type=integer(0), default=0, metavar="N")
    parser.add_argument("--csv", type=Path, metavar="DIR", help="write the tables there, too")
    options = parser.parse_args()
    return max(_run(name, options) for name in options.names)


def _run(name: str, options: argparse.Namespace) -> int:
    bench = _BENCHES[name]
    conditions = {condition.name: condition for condition in bench.conditions()}
    chosen = matching(list(conditions), options.only)
    if not chosen:
        names = ", ".join(list(conditions)[:4])
        sys.stderr.write(f"{name}: no condition has {options.only} in its name, as {names} have\n")
        return 2
    start, rows = time.perf_counter(), [bench.COLUMNS]
    width = max(map(len, chosen))
    print("".join(_cells(bench.COLUMNS, bench.COLUMNS, width)))
    for one in chosen:
        rows.append(bench.row(conditions[one], options.frames, options.seed))
        print("".join(_cells(bench.COLUMNS, rows[-1], width)), flush=True)
    print(f"{time.perf_counter() - start:.0f} s")
    if options.csv is not None:
        options.csv.mkdir(parents=True, exist_ok=True)
        with (options.csv / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(rows)
    return 0


def _cells(columns: Sequence[str], row: Sequence[str | float | int], width: int) -> Iterator[str]:
    yield f"{row[0]:{width}}"
    for name, value in zip(columns[1:], row[1:], strict=True):
        text = f"{value:.3g}" if isinstance(value, float) else str(value)
        yield f"  {text}" if name == "reasons" else f"{text:>{max(9, len(name) + 1)}}"


if __name__ == "__main__":
    sys.exit(main())
