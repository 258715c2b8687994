"""What an experiment returns: tables, figures, and claims with their verdicts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Protocol, TypeVar

from matplotlib.figure import Figure

T = TypeVar("T")


class Verdict(StrEnum):
    """What our figures say of a claim."""

    HELD = "held"
    NOT_HELD = "did not hold"
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


def judge(
    name: str, source: str, statement: str, criterion: str, finding: str, held: bool, why: str = ""
) -> Claim:
    """A claim and its verdict; ``why`` is kept for one that does not hold."""
    verdict = Verdict.HELD if held else Verdict.NOT_HELD
    return Claim(name, source, statement, criterion, finding, verdict, "" if held else why)


def not_tested(name: str, source: str, statement: str, criterion: str, reason: str) -> Claim:
    """A claim that this run says nothing of."""
    return Claim(name, source, statement, criterion, reason, Verdict.NOT_TESTED)


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
    webcam: Path  # recording of a chessboard
    webcam_readout_time: float
    hand_motion: Path  # trajectory
