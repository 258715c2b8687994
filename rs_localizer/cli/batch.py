# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``replay``, ``detect``, ``calibrate`` and ``evaluate`` of many recordings at once."""

from __future__ import annotations

import argparse
import contextlib
import csv
import fcntl
import importlib.util
import os
import shutil
import time
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rs_localizer.cli import WORKING, UsageError, integer

if WORKING:
    from tqdm import tqdm

    from rs_localizer.io.atomic_files import atomic_files, write_errors
    from rs_localizer.io.remote import Location, is_url
    from rs_localizer.offline.fleet.cluster import Where, perform_all
    from rs_localizer.offline.fleet.task import (
        PARTIAL,
        Figures,
        Kind,
        Task,
        finished,
        folder_names,
        identity,
        program,
        read_marker,
        readable,
    )

if TYPE_CHECKING:  # half a second of importing, which workers do not need
    from matplotlib.figure import Figure

# Arguments that say what to do with which recordings, and nothing of a result.
_OF_THE_FLEET = ("recordings", "out", "workers", "scheduler", "overwrite")

# Held while results are written.
_LOCK = ".lock"

# Figures of a recording that are told while others are waited for.
_TOLD = 5


def add_batch_arguments(parser: argparse.ArgumentParser) -> None:
    """How many recordings are shared out."""
    fleet = parser.add_argument_group(
        "many recordings",
        "Each goes into a folder of its own below --out; what is complete is not done again. Needs "
        "Dask: pip install 'rs_localizer[fleet]'.",
    )
    fleet.add_argument(
        "--workers",
        type=integer(1),
        metavar="N",
        help="processes of this machine (default: one for each core)",
    )
    fleet.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="instead: the workers of a Dask scheduler, such as tcp://host:8786; they have to see "
        "the same files",
    )


def is_batch(args: Namespace) -> bool:
    """Whether there are many recordings, or one is to be treated as many."""
    return len(args.recordings) > 1 or args.workers is not None or args.scheduler is not None


def run_batch(
    args: Namespace,
    kind: Kind,
    inputs: Callable[[Any], Sequence[Location | None]],
    overwrite: bool | None = None,
    gather: Callable[[Sequence[Path]], object] | None = None,
) -> None:
    """Do all recordings that are not done yet, and write the summary.

    Args:
        args: of the command.
        kind: what is done with each recording.
        inputs: what a result depends on beside the recording and the settings.
        overwrite: whether results of other settings are replaced; None: the command has no such
            option.
        gather: what is made of the folders of all complete results, in the order of the recordings.

    Raises:
        UsageError: for options that do not go together.
        ValueError: when results of other settings are in the way, or some recordings fail.
    """
    if args.out is None:
        raise UsageError("many recordings need --out DIR, for a folder of each")
    if args.workers is not None and args.scheduler is not None:
        raise UsageError("--workers are of this machine; give it or --scheduler")
    if importlib.util.find_spec("distributed") is None:
        raise ValueError(
            "many recordings need Dask, which is not installed: pip install 'rs_localizer[fleet]'"
        )
    out = args.out.resolve()
    tasks = _tasks(args, kind, inputs, out)
    _check(tasks, overwrite)
    with write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    with only_one(out):
        rows = {task.name: Row(task.recording, task.name, OPEN, {}) for task in tasks}
        try:
            _work(tasks, Where(args.scheduler, args.workers), rows)
        finally:
            shutil.rmtree(out / PARTIAL, ignore_errors=True)
            _find_finished(tasks, rows)
            write_summary(out, kind.command, list(rows.values()))
        if gather is not None:
            gather([task.folder for task in tasks if rows[task.name].state == DONE])
    print(f"written to {args.out}: {CSV}, {MARKDOWN}, {PICTURE}")
    if failed := sum(row.state == FAILED for row in rows.values()):
        raise ValueError(f"{failed} of {len(rows)} recordings failed; {args.out / CSV} says why")


def _tasks(
    args: Namespace, kind: Kind, inputs: Callable[[Any], Sequence[Location | None]], out: Path
) -> list[Task]:
    recordings = list(dict.fromkeys(map(_absolute, args.recordings)))
    kept = {name: value for name, value in vars(args).items() if name not in _OF_THE_FLEET}
    arguments = Namespace(
        **{name: _absolute(v) if isinstance(v, Path) else v for name, v in kept.items()}
    )
    settings = readable(arguments)
    names = folder_names(recordings, (CSV, MARKDOWN, PICTURE, PARTIAL, _LOCK))
    tasks = []
    for recording, name in zip(recordings, names, strict=True):
        files = [file if is_url(file) else Path(file) for file in inputs(recording) if file]
        own = identity(kind.command, settings, [recording, *files])
        tasks.append(Task(kind, arguments, recording, out, name, own, program()))
    return tasks


def _absolute(place: Location) -> Location:
    """Without "..", and with links as they are called; URLs as they are."""
    return place if is_url(place) else Path(os.path.abspath(place))


def _check(tasks: list[Task], overwrite: bool | None) -> None:
    """Refuse what would be overwritten, before hours of work."""
    for task in tasks:
        if not task.folder.exists() or finished(task) is not None:
            continue
        made = read_marker(task.folder)
        # What another command made may be the only one there is, or even the recording itself.
        if made is None or made.get("command") != task.kind.command:
            raise ValueError(
                f"{task.folder} exists and is no result of {task.kind.command}; choose another "
                "--out, or remove it"
            )
        if not overwrite:
            way_out = "remove it" if overwrite is None else "--overwrite"
            raise ValueError(
                f"{task.folder} is a result of other settings, another recording or another "
                f"version; choose another --out, or {way_out}"
            )


@contextlib.contextmanager
def only_one(out: Path) -> Iterator[None]:
    """Within ``with``, no other process writes results into a directory."""
    with (out / _LOCK).open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ValueError(f"another command is writing into {out}; wait for its end") from None
        yield


def _work(tasks: list[Task], where: Where, rows: dict[str, Row]) -> None:
    started, busy = time.perf_counter(), 0.0
    open_tasks = _find_finished(tasks, rows)
    if before := len(tasks) - len(open_tasks):
        print(f"{before} of {len(tasks)} recordings have been done before")
    bar = tqdm(total=len(tasks), initial=before, unit="recording", disable=None)
    with bar, contextlib.closing(perform_all(open_tasks, where)) as outcomes:
        for outcome in outcomes:
            state = FAILED if outcome.figures is None else DONE
            figures = outcome.figures or {}
            row = replace(rows[outcome.name], state=state, figures=figures, reason=outcome.reason)
            rows[outcome.name] = row
            busy += outcome.seconds
            bar.update()
            bar.write(f"{row.folder}: {_said(row)}")
    wall = time.perf_counter() - started
    print(_counted(list(rows.values())))
    if open_tasks:
        print(f"{wall:.1f} s for {busy:.1f} s of work")


def _find_finished(tasks: list[Task], rows: dict[str, Row]) -> list[Task]:
    """Enter what is complete on disk; the tasks of which nothing is known."""
    open_tasks = []
    for task in tasks:
        if rows[task.name].state != OPEN:
            continue
        if (figures := finished(task)) is None:
            open_tasks.append(task)
        else:
            rows[task.name] = replace(rows[task.name], state=DONE, figures=figures)
    return open_tasks


def _said(row: Row) -> str:
    if row.state == FAILED:
        return f"failed: {row.reason}"
    said = [
        f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in row.figures.items()
        if value != ""
    ]
    return ", ".join(said[:_TOLD])


def folder_name(option: str, folder: Path | None) -> str | None:
    """The name of a folder that each result gets.

    Raises:
        UsageError: when it is more than a name.
    """
    if folder is None:
        return None
    if len(folder.parts) != 1 or folder.is_absolute() or folder.name in ("", ".."):
        raise UsageError(f"{option} is a name in the folder of each result, got {folder}")
    return folder.name


CSV, MARKDOWN, PICTURE = "summary.csv", "summary.md", "summary.png"

DONE, FAILED, OPEN = "done", "failed", "not done"
"""States of a recording; not done: the work was interrupted before."""

_FIRST, _LAST = ("recording", "folder", "state"), ("reason",)
_BAR = "\\|"  # in a cell
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
        values = (self.figures.get(name, "") for name in columns)
        figures = [f"{value:.6g}" if isinstance(value, float) else str(value) for value in values]
        return [str(self.recording), self.folder, self.state, *figures, self.reason]


def write_summary(out: Path, command: str, rows: Sequence[Row]) -> None:
    """Write :data:`CSV`, :data:`MARKDOWN` and :data:`PICTURE`, each at once.

    They say the same whoever did the work, in whatever order it was done.
    """
    columns = list(dict.fromkeys(name for row in rows for name in row.figures))
    cells = [row.cells(columns) for row in rows]
    names = [*_FIRST, *columns, *_LAST]
    with atomic_files(*(out / name for name in (CSV, MARKDOWN, PICTURE))) as (table, text, picture):
        with table.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(names)
            writer.writerows(map(_plain, row) for row in cells)
        lines = [
            f"# {command}: {_counted(rows)}",
            "",
            f"| {' | '.join(names)} |",
            f"|{'---|' * len(names)}",
            *(f"| {' | '.join(cell.replace('|', _BAR) for cell in row)} |" for row in cells),
        ]
        text.write_text("\n".join(lines) + "\n", encoding="utf-8")
        # Without the version of Matplotlib, which would change the bytes.
        _draw(rows, columns).savefig(picture, dpi=110, metadata={"Software": None})


def _counted(rows: Sequence[Row]) -> str:
    states = [row.state for row in rows]
    some = [f"{states.count(state)} {state}" for state in (DONE, FAILED, OPEN) if state in states]
    return f"{len(rows)} recordings: {', '.join(some)}"


def _plain(cell: str) -> str:
    """Text that a spreadsheet does not take for a formula."""
    with contextlib.suppress(ValueError):
        float(cell)
        return cell
    return f"'{cell}" if cell.startswith(("=", "+", "-", "@", "\t", "\r")) else cell


def _draw(rows: Sequence[Row], columns: Sequence[str]) -> Figure:
    """The first figures that are numbers, recording by recording; what failed is marked below."""
    from matplotlib.figure import Figure

    numbers = {
        name: [k for k, row in enumerate(rows) if isinstance(row.figures.get(name), (int, float))]
        for name in columns
    }
    shown = [name for name, known in numbers.items() if known][:_MOST_PANELS] or [""]
    figure = Figure((_WIDTH, 0.6 + _PANEL * len(shown)), layout="constrained")
    panels = figure.subplots(len(shown), sharex=True, squeeze=False)[:, 0]
    without = [k for k, row in enumerate(rows) if row.state != DONE]
    for panel, name in zip(panels, shown, strict=True):
        known = numbers.get(name, [])
        panel.plot(known, [float(rows[k].figures[name]) for k in known], "o", ms=3, color="#0072b2")
        bottom = panel.get_xaxis_transform()
        panel.plot(without, [0.04] * len(without), "x", color="#d55e00", transform=bottom)
        panel.set_ylabel(name, fontsize=8)
        panel.tick_params(labelsize=8)
        panel.grid(alpha=0.3)
    figure.suptitle(_counted(rows), fontsize=9)
    panels[-1].set_xlabel(f"recording, in the order of {CSV}; x: without a result", fontsize=8)
    return figure
