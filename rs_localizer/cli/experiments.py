"""``rs_localizer experiments``: the paper's experiments and ours, with a verdict on every claim."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TypeVar

from tqdm import tqdm

from rs_localizer import data
from rs_localizer.cli import UsageError
from rs_localizer.lab.experiments.report import (
    SUMMARY,
    count_verdicts,
    write_result,
    write_summary,
)
from rs_localizer.lab.experiments.results import Context, Result, Verdict
from rs_localizer.lab.experiments.table import EXPERIMENTS
from rs_localizer.settings import load_params_file

T = TypeVar("T")

# All experiments with so many trials take about a quarter of an hour on two cores.
_TRIALS = 2000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help=f"which ones, of {', '.join(EXPERIMENTS)} (default: all)",
    )
    parser.add_argument(
        "--trials",
        type=int,
        default=_TRIALS,
        metavar="N",
        help="simulated frames per point of a curve; recordings and timings are cut in proportion, "
        "and below 500 compile times are left out (default: %(default)s, a quarter of an hour in "
        "all on two cores)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of all random numbers (default: 0)")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("experiments"),
        metavar="DIR",
        help=f"directory for tables (CSV), figures (PNG) and {SUMMARY} (default: %(default)s)",
    )


def run(args: argparse.Namespace) -> None:
    names = args.names or list(EXPERIMENTS)
    unknown = [name for name in names if name not in EXPERIMENTS]
    if unknown:
        raise UsageError(f"no experiment {unknown[0]!r}; choose from {', '.join(EXPERIMENTS)}")
    if args.trials < 1 or args.seed < 0:
        raise UsageError(
            f"--trials must be 1 or more and --seed 0 or more, got {args.trials} and {args.seed}"
        )
    args.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, Result] = {}
    seconds: dict[str, float] = {}
    for name in dict.fromkeys(names):
        start = time.perf_counter()
        results[name] = EXPERIMENTS[name](_context(name, args.trials, args.seed))
        seconds[name] = time.perf_counter() - start
        write_result(args.out, results[name])
        # After each, so that an interrupted run leaves what it found.
        write_summary(args.out, results, seconds, args.trials, args.seed)
        _print(name, results[name], seconds[name])
    claims = [claim for result in results.values() for claim in result.claims]
    print(f"{count_verdicts(claims)}; written to {args.out / SUMMARY}")


def _context(name: str, trials: int, seed: int) -> Context:
    webcam = data.path(data.WEBCAM)
    readout_time = load_params_file(webcam / "parameters.yaml")["readout_time"]
    return Context(
        trials,
        seed,
        partial(_track, name),
        webcam,
        readout_time,
        data.path(data.HAND_MOTION),
        data.path(data.SLOW_HAND_MOTION),
        data.path(data.GLOBAL_SHUTTER_TAGS),
    )


def _track(name: str, items: Iterable[T], total: int) -> Iterator[T]:
    # The bar is for a person who waits: none in a log file.
    yield from tqdm(items, total=total, desc=name, leave=False, disable=None)


def _print(name: str, result: Result, seconds: float) -> None:
    print(f"{name} ({seconds:.0f} s)")
    for claim in result.claims:
        print(f"  {claim.verdict:13} {claim.statement}: {claim.finding}")
        if claim.verdict is Verdict.NOT_HELD:
            print(f"  {'':13}   expected: {claim.criterion}")
    for note in result.notes:
        print(f"\n{note}\n")
