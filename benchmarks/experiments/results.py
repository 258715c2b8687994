# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables, figures and claims of an experiment, and how they are written."""

import csv
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar

from matplotlib.figure import Figure

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Claim:
    """A sentence that figures can contradict."""

    name: str  # experiment.claim
    statement: str
    criterion: str  # what would have to be measured for it to hold
    finding: str  # what was measured
    held: bool
    why: str = ""  # where it does not hold

    @property
    def verdict(self) -> str:
        return "held" if self.held else "did not hold"


def limited(
    name: str, statement: str, what: str, found: float | Iterable[float],
    least: float = -math.inf, most: float = math.inf, why: str = "",
) -> Claim:  # fmt: skip
    """A claim that a figure lies within limits; of several, all of them."""
    every = [float(found)] if isinstance(found, int | float) else [float(x) for x in found]
    limits = [f"at least {least:.3g}"] if math.isfinite(least) else []
    limits += [f"at most {most:.3g}"] if math.isfinite(most) else []
    finding = " to ".join(f"{x:.3g}" for x in sorted({min(every), max(every)}))
    held = least <= min(every) and max(every) <= most
    return Claim(
        name, statement, f"{what}: {', '.join(limits)}", finding, held, "" if held else why
    )


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of a CSV file."""

    columns: tuple[str, ...]
    rows: Sequence[Sequence[str | float | int]]

    def text(self) -> str:
        """Aligned columns, the first one flush left."""
        cells = [self.columns, *([_cell(x) for x in row] for row in self.rows)]
        widths = [max(len(row[k]) for row in cells) + 2 for k in range(len(self.columns))]
        return "\n".join(
            row[0].ljust(widths[0] - 2)
            + "".join(x.rjust(width) for x, width in zip(row[1:], widths[1:], strict=True))
            for row in cells
        )

    def write(self, file: Path) -> None:
        """As CSV."""
        rows = [self.columns, *([_cell(x) for x in row] for row in self.rows)]
        with file.open("w", newline="", encoding="utf-8") as stream:
            csv.writer(stream).writerows(rows)


@dataclass(frozen=True, slots=True)
class Result:
    """All that an experiment found."""

    claims: Sequence[Claim]
    notes: Sequence[str]  # tables for people
    figures: Mapping[str, Figure] = field(default_factory=dict)  # by the names of their files


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


def verdicts(claims: Sequence[Claim]) -> str:
    """Return how many claims held, and which ones did not, as ``12 held; not motion.poor``."""
    held = f"{sum(claim.held for claim in claims)} held"
    others = ", ".join(claim.name for claim in claims if not claim.held)
    return f"{held}; not {others}" if others else held


def rounded(value: float) -> str:
    """Two significant digits, without an exponent."""
    return f"{float(f'{value:.2g}'):g}"


def _cell(value: str | float | int) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
