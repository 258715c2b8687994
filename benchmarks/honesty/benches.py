# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The benches by name, each a list of conditions and what is measured of one of them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from benchmarks.honesty import against_p3p, rendered, tags
from benchmarks.honesty.estimating import Found

_CELL = 9  # characters of a figure


def heading(columns: Sequence[str], first: int) -> str:
    """The names of the columns; ``first``: width of the first one."""
    return line(columns, columns, first)


def line(columns: Sequence[str], row: Sequence[str | float | int], first: int) -> str:
    """One row: its name to the left, figures with three digits, words at the end."""
    cells = [f"{row[0]:{first}}"]
    cells += [
        f"{_text(value):>{max(_CELL, len(name) + 1)}}" if name != "reasons" else f"  {value}"
        for name, value in zip(columns[1:], row[1:], strict=True)
    ]
    return "".join(cells).rstrip()


def table(columns: Sequence[str], rows: Sequence[Sequence[str | float | int]]) -> str:
    """All of it."""
    width = max([len(str(row[0])) for row in rows], default=0)
    return "\n".join([heading(columns, width), *(line(columns, row, width) for row in rows)])


def _text(value: str | float | int) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.3g}" if value < 100 else f"{value:.0f}"
    return str(value)


_FULL = 100  # frames of a condition at which recordings are replayed in full


class Named(Protocol):
    """A condition."""

    @property
    def name(self) -> str: ...


C = TypeVar("C", bound=Named)
F = TypeVar("F")


@dataclass(frozen=True, slots=True)
class Bench(Generic[C, F]):
    """Conditions and what is measured of one: by frames per condition, and seed."""

    title: str
    conditions: Sequence[C]
    measure: Callable[[C, int, int], F]
    columns: tuple[str, ...]
    row: Callable[[str, F], tuple[str | float | int, ...]]

    def matching(self, words: Sequence[str]) -> list[C]:
        """The conditions in whose names each of these begins a word: ``3px`` is not ``0.3px``."""
        patterns = [re.compile(rf"(^|[/ ]){re.escape(word)}") for word in words]
        return [
            one for one in self.conditions if all(pattern.search(one.name) for pattern in patterns)
        ]

    def run(self, conditions: Sequence[C], frames: int, seed: int) -> Iterator[tuple[str, F]]:
        """One after the other."""
        for condition in conditions:
            yield condition.name, self.measure(condition, frames, seed)


def benches(folder: Path) -> dict[str, Bench[Any, Any]]:
    """All of them; the corners of rendered images are kept in the folder."""

    def replay_tags(condition: tags.Condition, frames: int, _: int) -> tags.Replayed:
        share = min(1.0, frames / _FULL)
        return tags.measure(condition, max(1, round(share * tags.FRAMES)))

    def replay_rendered(condition: rendered.Condition, frames: int, _: int) -> Found:
        seconds = rendered.SECONDS * min(1.0, frames / _FULL)
        return rendered.measure(condition, folder, seconds)

    return {
        "p3p": Bench(
            "Against P3P", against_p3p.conditions(), against_p3p.measure, against_p3p.COLUMNS,
            against_p3p.row,
        ),
        "tags": Bench("Tags", tags.conditions(), replay_tags, tags.COLUMNS, tags.row),
        "rendered": Bench(
            "Rendered walls", rendered.conditions(), replay_rendered, rendered.COLUMNS, rendered.row
        ),
    }  # fmt: skip
