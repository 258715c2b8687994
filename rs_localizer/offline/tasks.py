# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Tasks of many recordings: their folders, which of them are done, and a table of the outcomes."""

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from rs_localizer.io.atomic_files import atomic_files, content

Figures = dict[str, float | int | str]
"""Figures of a recording, by identifiers with their units."""

Outcome = Figures | str
"""Figures of a task that is done; of one that failed, why, in one line."""

MARKER, LOG = "fleet.json", "log.txt"
"""Files in each result: a marker, which is written last and names recording and settings, and the
output of the command."""
SUMMARY = "summary.csv"
"""A row of each recording."""

VERSION = version("rs_localizer")


@dataclass(frozen=True, slots=True)
class Task:
    """One recording, and what its result is made with."""

    work: Callable[[Path, Path], Figures]  # of a recording, and the folder to create; pickled
    recording: Path  # absolute, as the folder: workers are elsewhere
    folder: Path
    settings: str  # version and options, as text


def tasks_of(
    recordings: Sequence[Path], out: Path, work: Callable[[Path, Path], Figures], settings: str
) -> list[Task]:
    """Return a task for each different recording, with a folder of its own below ``out``."""
    made = dict[str, Task]()
    places = {path.absolute(): path.name if path.is_dir() else path.stem for path in recordings}
    for place, name in places.items():
        if list(places.values()).count(name) > 1:
            name = f"{place.parent.name}_{name}"
        while name in made:
            name += "_"
        made[name] = Task(work, place, out / name, f"{VERSION} {settings}")
    return list(made.values())


def finished(task: Task) -> Figures | None:
    """Return the figures of a complete result of just this task; None if there is none."""
    try:
        about = json.loads((task.folder / MARKER).read_text(encoding="utf-8"))
        of = about["recording"], about["settings"]
        return dict(about["figures"]) if of == (str(task.recording), task.settings) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def refuse_others(tasks: Sequence[Task]) -> None:
    """Raise ``ValueError`` for a folder that is there, and no result of its task."""
    for task in tasks:
        if content(task.folder) and finished(task) is None:
            raise ValueError(
                f"{task.folder} exists and is no result of this recording, settings and version; "
                "choose another --out, or --overwrite"
            )


def summarize(outcomes: Mapping[Task, Outcome], file: Path) -> None:
    """Write the table of outcomes, which is the same with any number of workers."""
    rows = [
        {"recording": str(task.recording), "folder": task.folder.name}
        | ({"reason": outcome} if isinstance(outcome, str) else outcome)
        for task, outcome in outcomes.items()
    ]
    columns = dict.fromkeys(name for row in rows for name in row if name != "reason")
    with atomic_files(file) as (part,), part.open("w", encoding="utf-8", newline="") as text:
        writer = csv.DictWriter(text, [*columns, "reason"], lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)


def _cell(value: float | str) -> str:
    """Return text that a spreadsheet does not take for a formula."""
    cell = f"{value:.6g}" if isinstance(value, float) else str(value)
    return f"'{cell}" if cell[:1] in ("=", "+", "@") else cell
