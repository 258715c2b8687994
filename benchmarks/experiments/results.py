# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What an experiment returns: tables, figures, and claims with their verdicts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol, TypeVar

from matplotlib.figure import Figure

from benchmarks.experiments.uncertainty import Interval

T = TypeVar("T")


class Verdict(StrEnum):
    """What our figures say of a claim."""

    HELD = "held"
    NOT_HELD = "did not hold"
    UNDECIDED = "undecided"  # too few trials to tell
    NOT_TESTED = "not tested"


@dataclass(frozen=True, slots=True)
class Claim:
    """A sentence that figures can contradict."""

    name: str  # experiment.claim
    source: str  # who says so
    statement: str
    criterion: str  # what would have to be measured for it to hold
    finding: str  # what was measured
    verdict: Verdict
    why: str = ""  # where it does not hold


@dataclass(frozen=True, slots=True)
class Statement:
    """What somebody says, before figures judge it; the fields are those of a claim."""

    name: str
    source: str
    statement: str
    criterion: str

    def judged(self, finding: str, held: bool, why: str = "") -> Claim:
        """By a fact; ``why`` is kept where it does not hold."""
        if held:
            return self._claim(finding, Verdict.HELD)
        return self._claim(finding, Verdict.NOT_HELD, why)

    def judged_by(
        self,
        finding: str,
        intervals: Sequence[Interval],
        limits: tuple[float, float],
        why: str = "",
    ) -> Claim:
        """By figures that have to lie between limits, as well as they are known.

        It holds where all intervals lie within, does not where one lies outside, and is undecided
        between.
        """
        if any(interval.outside(*limits) for interval in intervals):
            return self._claim(finding, Verdict.NOT_HELD, why)
        if all(interval.within(*limits) for interval in intervals):
            return self._claim(finding, Verdict.HELD)
        trials = min(interval.trials for interval in intervals)
        return self._claim(f"{finding}; undecided at {trials} trials", Verdict.UNDECIDED)

    def not_tested(self, reason: str) -> Claim:
        """This run says nothing of it."""
        return self._claim(reason, Verdict.NOT_TESTED)

    def _claim(self, finding: str, verdict: Verdict, why: str = "") -> Claim:
        return Claim(self.name, self.source, self.statement, self.criterion, finding, verdict, why)


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of a CSV file."""

    columns: tuple[str, ...]
    rows: Sequence[Sequence[str | float | int]]


@dataclass(frozen=True, slots=True)
class Result:
    """All that an experiment found; the keys of tables and figures become file names.

    ``files`` are animated pictures, by their names, already encoded.
    """

    title: str
    setting: str  # a paragraph: what was done
    claims: Sequence[Claim]
    tables: Mapping[str, Table]
    figures: Mapping[str, Figure] = field(default_factory=dict)
    notes: Sequence[str] = ()  # further paragraphs
    files: Mapping[str, bytes] = field(default_factory=dict)


class Track(Protocol):
    """Passes items on, one by one, while someone watches the progress."""

    def __call__(self, items: Iterable[T], total: int, /) -> Iterator[T]: ...


@dataclass(frozen=True, slots=True)
class Context:
    """What all experiments are told.

    Fewer trials make everything shorter: of simulated frames so many are drawn per point of a
    curve, and recordings and timings are cut in proportion.
    """

    trials: int
    seed: int
    track: Track
