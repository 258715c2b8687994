# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Many recordings: one function, mapped over them here or by Dask; finished ones are skipped."""

import contextlib
import csv
import io
import json
import logging
import socket
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rs_localizer.io.atomic_files import atomic_directory, atomic_files, content, write_errors
from rs_localizer.process import ignore_working_folder

Figures = dict[str, float | int | str]
"""Figures of a recording, by identifiers with their units."""

Outcome = Figures | str
"""Figures of a task that is done; of one that failed, why, in one line."""

MARKER, LOG = "fleet.json", "log.txt"
"""In each complete result: what it is of, written last; and what the command would have said."""
SUMMARY = "summary.csv"
"""A row of each recording."""

_PACKAGE = "rs_localizer"
# Scheduler that answers nothing for so long is none, s.
_CONNECT_TIMEOUT = 5.0
# Level of what Dask logs: what goes wrong is an outcome or an error.
_SILENT = logging.CRITICAL + 1
# Dask gives levels of their own to these; after Ctrl-C a client logs that its wait was cancelled.
_LOGGERS = ("distributed", "distributed.client", "tornado.application")
# Run by each worker. A terminal's Ctrl-C comes to all: this process ends for it, and ends the
# others, which would log that their tasks were cancelled.
_PRELOAD = f"""import logging, signal
signal.signal(signal.SIGINT, signal.SIG_IGN)
logging.getLogger("distributed").setLevel({_SILENT})
"""


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
        made[name] = Task(work, place, out / name, f"{version(_PACKAGE)} {settings}")
    return list(made.values())


def finished(task: Task) -> Figures | None:
    """Return the figures of a complete result of just this task; None if there is none."""
    try:
        about = json.loads((task.folder / MARKER).read_text(encoding="utf-8"))
        of = about["recording"], about["settings"]
        return dict(about["figures"]) if of == (str(task.recording), task.settings) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def perform_task(task: Task) -> Outcome:
    """Do a task, unless it has been done; its folder is there afterwards, whole, or not at all.

    Whatever goes wrong with the recording is an outcome, not an exception.
    """
    ignore_working_folder()  # of a worker of Dask, which another program has started
    here, said = socket.gethostname(), io.StringIO()
    if not task.settings.startswith(f"{version(_PACKAGE)} "):
        return f"the worker on {here} has another rs_localizer: install the same"
    if not task.folder.parent.is_dir():
        return f"the worker on {here} does not see {task.folder.parent}"
    if (known := finished(task)) is not None:
        return known
    inner = task.folder
    try:
        # The existing result has other settings.
        with atomic_directory(task.folder, content(task.folder)) as inner:
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                figures = task.work(task.recording, inner)
            (inner / LOG).write_text(said.getvalue().replace(str(inner), task.folder.name))
            about = {"recording": task.recording, "settings": task.settings, "figures": figures}
            (inner / MARKER).write_text(json.dumps(about, indent=1, default=str))
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        kind = "" if isinstance(error, (ValueError, OSError)) else f"{type(error).__name__}: "
        return (kind + text).replace(str(inner), str(task.folder))
    return figures


def perform_all(
    tasks: Sequence[Task], scheduler: str | None, workers: int | None
) -> Generator[tuple[Task, Outcome]]:
    """Yield the outcome of each task, as they come; closing the iterator stops all.

    Dask has the scheduler at an address, or starts workers here; without both: this process alone.

    Raises:
        ValueError: when no scheduler answers.
        ImportError: without Dask.
    """
    if scheduler is None and workers is None:
        yield from ((task, perform_task(task)) for task in tasks)
        return
    import dask.config
    from distributed import Client, KilledWorker, LocalCluster, as_completed

    for name in _LOGGERS:
        logging.getLogger(name).setLevel(_SILENT)
    with contextlib.ExitStack() as stack:
        place: Any = scheduler
        if scheduler is None:
            stack.enter_context(dask.config.set({"distributed.scheduler.allowed-failures": 0}))
            place = stack.enter_context(LocalCluster(
                n_workers=workers, threads_per_worker=1, dashboard_address=None, preload=_PRELOAD
            ))  # fmt: skip
        try:
            client = stack.enter_context(Client(place, timeout=_CONNECT_TIMEOUT))
        except (OSError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"no Dask scheduler answers at {scheduler}: {reason}") from error
        # Not by what they are: a result that has been removed would be taken as done.
        futures = dict(zip(client.map(perform_task, tasks, pure=False), tasks, strict=True))
        again = list[Task]()  # Dask blames all that waited at a worker for its end
        for future in as_completed(futures):
            if isinstance(future.exception(), KilledWorker):
                again.append(futures[future])
            else:
                yield futures[future], _outcome(future)
        yield from (
            (task, _outcome(client.submit(perform_task, task, pure=False))) for task in again
        )


def _outcome(future: Any) -> Outcome:
    if (error := future.exception()) is None:
        return future.result()  # type: ignore[no-any-return]
    return f"lost: {' '.join(str(error).split())[:200]}"


def refuse_others(tasks: Sequence[Task]) -> None:
    """Raise ``ValueError`` for a folder that is there, and no result of its task."""
    for task in tasks:
        if content(task.folder) and finished(task) is None:
            raise ValueError(
                f"{task.folder} exists and is no result of this recording, settings and version; "
                "choose another --out, or --overwrite"
            )


def do_all(
    tasks: Sequence[Task], out: Path, scheduler: str | None, workers: int | None,
    heard: Callable[[Task, Outcome], object],
) -> dict[Path, Outcome]:  # fmt: skip
    """Return the outcomes by folder; the summary in ``out`` is written however it ends.

    ``heard`` is told of tasks that had not been done before. Raises as :func:`perform_all` does.
    """
    with write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    outcomes = dict[Path, Outcome]()
    waiting = [task for task in tasks if finished(task) is None]
    try:
        with contextlib.closing(perform_all(waiting, scheduler, workers)) as performed:
            for task, outcome in performed:
                outcomes[task.folder] = outcome
                heard(task, outcome)
    finally:
        for task in tasks:  # done before, or not heard of, as after Ctrl-C
            outcomes.setdefault(task.folder, finished(task) or "not done")
        _summarize({task: outcomes[task.folder] for task in tasks}, out / SUMMARY)
    return outcomes


def _summarize(outcomes: Mapping[Task, Outcome], file: Path) -> None:
    """Write the table, which is the same with any number of workers and in any order."""
    known = [{} if isinstance(outcome, str) else outcome for outcome in outcomes.values()]
    columns = list(dict.fromkeys(name for figures in known for name in figures))
    with atomic_files(file) as (part,), part.open("w", encoding="utf-8", newline="") as text:
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["recording", "folder", *columns, "reason"])
        for (task, outcome), figures in zip(outcomes.items(), known, strict=True):
            values = [figures.get(name, "") for name in columns]
            cells = [f"{v:.6g}" if isinstance(v, float) else str(v) for v in values]
            reason = outcome if isinstance(outcome, str) else ""
            row = [str(task.recording), task.folder.name, *cells, reason]
            # Text that a spreadsheet does not take for a formula.
            writer.writerow([f"'{cell}" if cell[:1] in ("=", "+", "@") else cell for cell in row])
