# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks NAME``: the paper's experiments and ours, with a verdict on every claim.

This is the only place that names them all.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

from tqdm import tqdm

from benchmarks import command
from benchmarks.experiments import (
    convergence,
    from_p3p,
    linearisation,
    motion,
    noise,
    sequences,
    timings,
    translation,
)
from benchmarks.experiments.results import Claim, Context, Result, verdicts
from benchmarks.real import __main__ as real

T = TypeVar("T")

EXPERIMENTS: dict[str, Callable[[Context], Result]] = {
    "motion": motion.run,
    "translation": translation.run,
    "noise": noise.run,
    "convergence": convergence.run,
    "linearisation": linearisation.run,
    "from-p3p": from_p3p.run,
    "sequences": sequences.run,
    "timings": timings.run,
}

_TOOLS = """more, each with its own --help, as python -m benchmarks.NAME:
  frames                           regions, errors and times of frames; two versions compared
  integrity                        the chance of a wrong pose or map: reliability, ROC
  rigs                             several cameras, one of them wrong
  real                             videos of real cameras; real gyro BAG: before a gyroscope
  faulty_gyroscopes                gyroscopes that are wrong, beside the camera alone
  kinds                            faults that no frame's model has: what is noticed
  mapping                          refined maps and surveyed markers
  fuzzing                          wrong input for everything that reads
  load                             live nodes under load
  page                             what a bench prints, into the docs
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run experiments; the exit code: 0 done, 1 the work failed, 2 wrong usage."""
    argv = sys.argv[1:] if argv is None else argv
    if argv and argv[0] == "real":
        return real.main(argv[1:])
    about = "The experiments of the literature and ours: curves and a verdict on every claim."
    parser = command("", about)
    parser.epilog = _TOOLS
    parser.add_argument(
        "names", nargs="*", metavar="NAME",
        help=f"which ones, of {', '.join(EXPERIMENTS)} (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--trials", type=int, default=2000, metavar="N",
        help="simulated frames per point of a curve; timings are cut in proportion "
        "(default: %(default)s, some minutes)",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=0, help="of all random numbers (default: 0)")
    parser.add_argument(
        "--out", type=Path, default=Path("experiments"), metavar="DIR",
        help="directory for the figure of docs/solvers.md (default: %(default)s)",
    )  # fmt: skip
    args = parser.parse_args(argv)
    unknown = [name for name in args.names if name not in EXPERIMENTS]
    if unknown:
        parser.error(f"no experiment {unknown[0]!r}; choose from {', '.join(EXPERIMENTS)}")
    if args.trials < 1 or args.seed < 0:
        parser.error(
            f"--trials must be 1 or more and --seed 0 or more, got {args.trials} and {args.seed}"
        )
    try:
        run(args)
    except OSError as error:
        sys.stderr.write(f"{parser.prog}: {error}\n")
        return 1
    return 0


def run(args: argparse.Namespace) -> None:
    claims: list[Claim] = []
    for name in dict.fromkeys(args.names or EXPERIMENTS):
        start = time.perf_counter()
        context = Context(args.trials, args.seed, partial(_track, name))
        result = EXPERIMENTS[name](context)
        for file, figure in result.figures.items():
            args.out.mkdir(parents=True, exist_ok=True)
            figure.savefig(args.out / f"{file}.png")
        sys.stderr.write(f"{name} ({time.perf_counter() - start:.0f} s)\n")
        for one in result.claims:
            said = f"  {one.verdict:13} {one.statement}: {one.finding} ({one.criterion})\n"
            sys.stderr.write(said + f"    {one.why}\n" * bool(one.why))
        print(*result.notes, sep="\n", flush=True)
        claims += result.claims
    print(verdicts(claims))


def _track(name: str, items: Iterable[T], total: int) -> Iterator[T]:
    # The bar is for a person who waits: none in a log file.
    yield from tqdm(items, total=total, desc=name, leave=False, disable=None)


if __name__ == "__main__":
    sys.exit(main())
