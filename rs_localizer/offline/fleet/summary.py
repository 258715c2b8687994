# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""One summary of many recordings: a table for programs, one for people, and a picture."""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rs_localizer.io.atomic_files import atomic_files
from rs_localizer.io.remote import Location
from rs_localizer.offline.fleet.task import Figures

if TYPE_CHECKING:  # half a second of importing, which workers do not need
    from matplotlib.figure import Figure

CSV, MARKDOWN, PICTURE = "summary.csv", "summary.md", "summary.png"

DONE, FAILED, OPEN = "done", "failed", "not done"
"""States of a recording; not done: the work was interrupted before."""

_FIRST, _LAST = ("recording", "folder", "state"), ("reason",)
_MOST_PANELS = 5
_WIDTH, _PANEL = 8.0, 1.7  # inches


@dataclass(frozen=True, slots=True)
class Row:
    """What the summary says of a recording."""

    recording: Location
    folder: str
    state: str
    figures: Figures
    reason: str = ""

    def cells(self, columns: Sequence[str]) -> list[str]:
        """The texts of these columns of figures, what is known of all before and behind."""
        figures = [_text(self.figures.get(name, "")) for name in columns]
        return [str(self.recording), self.folder, self.state, *figures, self.reason]


def write_summary(out: Path, command: str, rows: Sequence[Row]) -> None:
    """Write :data:`CSV`, :data:`MARKDOWN` and :data:`PICTURE`, each at once.

    They say the same whoever did the work, in whatever order it was done.
    """
    columns = list(dict.fromkeys(name for row in rows for name in row.figures))
    with atomic_files(*(out / name for name in (CSV, MARKDOWN, PICTURE))) as (table, text, picture):
        table.write_bytes(_as_csv(rows, columns))
        text.write_bytes(_as_markdown(command, rows, columns))
        # Without the version of Matplotlib, which would change the bytes.
        _draw(rows, columns).savefig(picture, dpi=110, metadata={"Software": None})


def counted(rows: Sequence[Row]) -> str:
    """How many of each state."""
    states = [row.state for row in rows]
    some = [f"{states.count(state)} {state}" for state in (DONE, FAILED, OPEN) if state in states]
    return f"{len(rows)} recordings: {', '.join(some)}"


def _as_csv(rows: Sequence[Row], columns: Sequence[str]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*_FIRST, *columns, *_LAST])
    writer.writerows(map(_plain, row.cells(columns)) for row in rows)
    return text.getvalue().encode()


def _as_markdown(command: str, rows: Sequence[Row], columns: Sequence[str]) -> bytes:
    names = [*_FIRST, *columns, *_LAST]
    lines = [
        f"# {command}: {counted(rows)}",
        "",
        f"| {' | '.join(names)} |",
        f"|{'---|' * len(names)}",
        *(f"| {' | '.join(map(_escaped, row.cells(columns)))} |" for row in rows),
    ]
    return ("\n".join(lines) + "\n").encode()


def _plain(cell: str) -> str:
    """Text that a spreadsheet does not take for a formula."""
    with contextlib.suppress(ValueError):
        float(cell)
        return cell
    return f"'{cell}" if cell.startswith(("=", "+", "-", "@", "\t", "\r")) else cell


def _escaped(cell: str) -> str:
    return cell.replace("|", "\\|")


def _text(value: float | int | str) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _draw(rows: Sequence[Row], columns: Sequence[str]) -> Figure:
    """The first figures that are numbers, recording by recording; what failed is marked below."""
    from matplotlib.figure import Figure

    numbers = [name for name in columns if any(_is_number(row, name) for row in rows)]
    shown = numbers[:_MOST_PANELS] or [""]
    figure = Figure((_WIDTH, 0.6 + _PANEL * len(shown)), layout="constrained")
    panels = figure.subplots(len(shown), sharex=True, squeeze=False)[:, 0]
    without = [k for k, row in enumerate(rows) if row.state != DONE]
    for panel, name in zip(panels, shown, strict=True):
        known = [k for k, row in enumerate(rows) if _is_number(row, name)]
        panel.plot(known, [float(rows[k].figures[name]) for k in known], "o", ms=3, color="#0072b2")
        bottom = panel.get_xaxis_transform()
        panel.plot(without, [0.04] * len(without), "x", color="#d55e00", transform=bottom)
        panel.set_ylabel(name, fontsize=8)
        panel.tick_params(labelsize=8)
        panel.grid(alpha=0.3)
    figure.suptitle(counted(rows), fontsize=9)
    panels[-1].set_xlabel(f"recording, in the order of {CSV}; x: without a result", fontsize=8)
    return figure


def _is_number(row: Row, name: str) -> bool:
    value = row.figures.get(name)
    return isinstance(value, (int, float)) and not isinstance(value, bool)
