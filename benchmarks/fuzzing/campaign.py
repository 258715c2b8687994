# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A run over all targets: counts what became of each input, and keeps what should not be."""

from __future__ import annotations

import resource
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import count, islice
from random import Random
from typing import Any

from benchmarks.fuzzing.targets import Target

# One input that takes longer (s) hangs, in our eyes.
_TOO_LONG = 5.0


@dataclass(frozen=True, slots=True)
class Failure:
    """An input that raised what it must not, or took too long."""

    target: str
    number: int  # of the execution: the same seed and number give the same input
    what: str
    case: Any


@dataclass(slots=True)
class Report:
    """What happened."""

    outcomes: dict[str, Counter[str]] = field(default_factory=dict)  # of each target
    failures: list[Failure] = field(default_factory=list)
    slowest: tuple[float, str, int] = (0.0, "", 0)  # s, target, number
    peak_mb: float = 0.0  # that the process grew by
    largest: tuple[float, str, int] = (0.0, "", 0)  # MB that one input added to it

    @property
    def executions(self) -> int:
        return sum(sum(counts.values()) for counts in self.outcomes.values())

    def text(self) -> str:
        """A table for people."""
        lines = []
        for target, counts in self.outcomes.items():
            listed = ", ".join(f"{name} {count}" for name, count in counts.most_common())
            lines.append(f"{target:18} {sum(counts.values()):9d}  {listed}")
        seconds, target, number = self.slowest
        grown, greedy, at = self.largest
        lines.append(
            f"{self.executions} executions, {len(self.failures)} failures; the process grew by "
            f"{self.peak_mb:.0f} MB, most of it {grown:.0f} MB ({greedy}, number {at}); the "
            f"slowest input took {1e3 * seconds:.0f} ms ({target}, number {number})"
        )
        for failure in self.failures[:20]:
            lines.append(f"\n{failure.target}, number {failure.number}: {failure.what:.300}")
            lines.append(f"  {failure.case!r:.2000}")
        return "\n".join(lines)


def case_of(target: Target, name: str, seed: int, number: int) -> Any:
    """The input of one execution."""
    return target.make(Random(f"{seed} {name} {number}"))


def run(targets: Mapping[str, Target], executions: int, seed: int) -> Iterator[Report]:
    """Feed all targets in turn; the report so far, after every execution."""
    report = Report({name: Counter() for name in targets})
    before = _peak_mb()
    for number, name in enumerate(islice(_turns(targets), executions)):
        last = _peak_mb()
        _execute(report, name, targets[name], seed, number)
        now = _peak_mb()
        if number <= len(targets):
            before = now  # until everything has been imported and tried once
        else:
            report.peak_mb = now - before
            report.largest = max(report.largest, (now - last, name, number))
        yield report


def _turns(targets: Mapping[str, Target]) -> Iterator[str]:
    for turn in count():
        yield from (name for name, target in targets.items() if turn % target.every == 0)


def _execute(report: Report, name: str, target: Target, seed: int, number: int) -> None:
    case = case_of(target, name, seed, number)
    start = time.process_time()  # on a busy machine the clock says nothing
    try:
        target.read(case)
        outcome = "read"
    except target.errors as error:
        outcome = type(error).__name__
    except Exception as error:
        outcome = f"FAILED: {type(error).__name__}"
        where = traceback.extract_tb(error.__traceback__)[-1]
        what = f"{error!r} in {where.name}, {where.filename}:{where.lineno}"
        report.failures.append(Failure(name, number, what, case))
    seconds = time.process_time() - start
    if seconds > _TOO_LONG:
        report.failures.append(Failure(name, number, f"took {seconds:.1f} s", case))
    report.outcomes[name][outcome] += 1
    report.slowest = max(report.slowest, (seconds, name, number))


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
