# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The commands of ``python -m benchmarks.frames``: run, compare, paired, times and gate.

Another version of the package is judged by the same benches from any other folder:

    cd /tmp; PYTHONPATH=/path/to/other/version:/path/to/this python -m benchmarks.frames run ...
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: one core, as in a node

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from benchmarks.experiments.results import Table
from benchmarks.frames import paired
from benchmarks.frames.compared import compare, totals, totals_line, write
from benchmarks.frames.conditions import BENCHES, conditions
from benchmarks.frames.judged import Judged, judge
from benchmarks.frames.timed import gate, times

_TOGETHER = {
    "localized": "found", "pose@m": "poses", "twist@m": "twists", ">5s": "beyond_5",
    "deg": "deg", "mm": "mm", "deg/s": "deg/s", "m/s": "m/s", "s_turn": "sharp", "ms": "ms",
    "ms_95": "ms_95",
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    return int(options.command(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.frames", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    run = commands.add_parser("run", help="judge the version that Python finds")
    run.add_argument("--out", type=Path, required=True, metavar="FILE.npz", help="every frame")
    run.add_argument("--bench", nargs="+", choices=tuple(BENCHES), metavar="NAME",
                     default=tuple(BENCHES), help=", ".join(BENCHES))  # fmt: skip
    run.add_argument("--only", nargs="+", default=(), metavar="WORD",
                     help="conditions with all these parts in their names")  # fmt: skip
    run.add_argument("--frames", type=int, default=40, metavar="N", help="of a condition (40)")
    run.add_argument("--seed", type=int, default=1, metavar="N", help="(1)")
    run.set_defaults(command=_run)
    against = commands.add_parser("compare", help="two runs, condition by condition")
    against.add_argument("before", type=Path, metavar="BEFORE.npz")
    against.add_argument("after", type=Path, metavar="AFTER.npz")
    against.add_argument("--all", action="store_true", help="also conditions that hardly differ")
    against.set_defaults(command=compare)
    paired.add_to(commands.add_parser("paired", help="some 1,500 frames, beside another version"))
    timed = commands.add_parser("times", help="CPU time beside PoseLib's")
    timed.add_argument("--frames", type=int, default=20, metavar="N", help="of a condition (20)")
    timed.add_argument("--rounds", type=int, default=7, metavar="N", help="of each frame (7)")
    timed.set_defaults(command=times)
    gated = commands.add_parser("gate", help="of CI: cost and coverage against what they were")
    gated.set_defaults(command=gate)
    return parser


def _run(options: argparse.Namespace) -> int:
    wanted = [
        one for one in conditions()
        if one.bench in options.bench and set(options.only) <= set(one.name.split("/"))
    ]  # fmt: skip
    if not wanted:
        sys.stderr.write(f"no condition has {' and '.join(options.only)} in its name\n")
        return 2
    judged: dict[str, Judged] = {}
    width = max(len(one.name) for one in wanted)
    for condition in wanted:
        one = judge(condition, options.frames, options.seed, {})
        if not judged or wanted[len(judged) - 1].bench != condition.bench:
            sys.stderr.write(f"{totals_line(condition.bench, None, width)}\n")
            if judged:  # who stops the run keeps the benches that are done
                write(options.out, judged)
        name = f"{condition.bench}/{condition.name}"
        judged[name] = one
        reasons = Counter(filter(None, one.reasons)).most_common()
        said = ", ".join(f"{count} {reason}" for reason, count in reasons)
        row = totals({name: one})["all"]
        sys.stderr.write(f"{totals_line(condition.name, row, width)}  {said}\n")
    write(options.out, judged)
    rows = [
        (bench, *(f"{total[name]:.3g}" for name in _TOGETHER))
        for bench, total in totals(judged).items()
    ]
    sys.stdout.write(f"{Table(('', *_TOGETHER.values()), rows).text()}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
