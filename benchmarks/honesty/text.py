# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables as aligned text, a line at a time."""

from __future__ import annotations

import math
from collections.abc import Sequence

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
