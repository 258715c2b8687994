# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Many recordings, each a task of its own, whichever process or machine does it."""

from __future__ import annotations

import contextlib
import csv
import fcntl
import functools
import hashlib
import io
import json
import logging
import multiprocessing
import os
import signal
import socket
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, cast

from rs_localizer.io.atomic_files import (
    atomic_directory,
    atomic_files,
    content,
    resume,
    resume_results,
    write_errors,
)
from rs_localizer.process import ignore_working_folder

Figures = dict[str, float | int | str]
"""Figures of a recording, by identifiers with their units."""

MARKER, LOG = "fleet.json", "log.txt"
"""In each complete result: what it is of, written last; and what the command would have said."""
SUMMARY = "summary.csv"
"""A row of each recording."""

_PACKAGE = Path(__file__).parents[1]
# Scheduler that answers nothing for so long is none, s.
_CONNECT_TIMEOUT = 5.0
# What is printed can be told apart only while one task of a process prints.
_PRINTING = threading.Lock()


Performed = Generator["tuple[Task, Outcome]"]


class ClusterError(ValueError):
    """No scheduler that answers; the message says why."""


@dataclass(frozen=True, slots=True)
class Task:
    """One recording, and all that its result depends on."""

    work: Callable[[Path, Path], Figures]  # of a recording, and the folder to create
    recording: Path  # absolute, as the folder: workers are elsewhere
    folder: Path
    identity: str
    program: str  # of who asks


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of a task."""

    figures: Figures | None  # None: it failed
    reason: str = ""  # why, in one line


@functools.cache
def program() -> str:
    """Digest of the sources of this package, its version among them."""
    digest = hashlib.sha256()
    for file in sorted(_PACKAGE.rglob("*.py")):
        digest.update(file.relative_to(_PACKAGE).as_posix().encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def tasks_of(
    recordings: Sequence[Path],
    out: Path,
    work: Callable[[Path, Path], Figures],
    settings: str,
    inputs: Sequence[Path] = (),
) -> list[Task]:
    """A task for each recording, with a folder of its own below ``out``.

    Args:
        recordings: what is localized; one that stands twice is done once.
        out: of all results.
        work: a function that can be pickled.
        settings: all that a result depends on beside the files, as text.
        inputs: other files that are read.
    """
    places = list(dict.fromkeys(Path(os.path.abspath(place)) for place in recordings))
    known = [_fingerprint(Path(file).absolute()) for file in inputs]
    made = []
    for place, name in zip(places, _names(places), strict=True):
        said = json.dumps([program(), settings, _fingerprint(place), known])
        identity = hashlib.sha256(said.encode()).hexdigest()
        made.append(Task(work, place, out / name, identity, program()))
    return made


def _fingerprint(place: Path) -> list[tuple[str, int, int]]:
    """Name, size and time of change (ns) of each file: reading all of a recording takes long."""
    files = sorted(place.rglob("*")) if place.is_dir() else [place]
    about = [(file, file.stat()) for file in files if file.is_file()]
    return [(str(file), stat.st_size, stat.st_mtime_ns) for file, stat in about]


def _names(places: Sequence[Path]) -> list[str]:
    """A name for each recording: its own, with its folder's or a number where others have it."""
    own = [place.name if place.is_dir() else place.stem for place in places]
    counts = Counter(own)
    names: list[str] = []
    for place, name in zip(places, own, strict=True):
        wanted = name if counts[name] == 1 else f"{place.parent.name}_{name}"
        number, free = 2, wanted
        while free in names:
            number, free = number + 1, f"{wanted}_{number}"
        names.append(free)
    return names


def finished(task: Task) -> Figures | None:
    """The figures of a complete result of just this task; None: there is none."""
    try:
        content = json.loads((task.folder / MARKER).read_text(encoding="utf-8"))
        return dict(content["figures"]) if content["identity"] == task.identity else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def perform(task: Task) -> Outcome:
    """Do a task, unless it has been done: its folder is there afterwards, whole, or not at all.

    Whatever goes wrong with the recording is an outcome, not an exception.
    """
    ignore_working_folder()  # of a worker of Dask, which another program has started
    here = socket.gethostname()
    if program() != task.program:
        return Outcome(None, f"the worker on {here} has another rs_localizer: install the same")
    if not task.folder.parent.is_dir():
        return Outcome(None, f"the worker on {here} does not see {task.folder.parent}")
    if (figures := finished(task)) is not None:
        return Outcome(figures)
    said, inner = io.StringIO(), task.folder
    try:
        # What is there is of other settings.
        with atomic_directory(task.folder, content(task.folder)) as inner:
            with _PRINTING, contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                figures = _worked(task, inner)
            about = {
                "recording": str(task.recording), "identity": task.identity, "figures": figures
            }  # fmt: skip
            text = said.getvalue().replace(str(inner), task.folder.name)
            (inner / LOG).write_text(text, encoding="utf-8")
            (inner / MARKER).write_text(json.dumps(about, indent=1, default=str), encoding="utf-8")
            if finished(task) is not None:
                raise ValueError(f"{task.folder} is there now")
    except Exception as error:
        # Another worker, taken for lost, may have been at it, too.
        if (known := finished(task)) is not None:
            return Outcome(known)
        text = " ".join(str(error).split()) or type(error).__name__
        kind = "" if isinstance(error, (ValueError, OSError)) else f"{type(error).__name__}: "
        return Outcome(None, (kind + text).replace(str(inner), str(task.folder)))
    return Outcome(figures)


def _worked(task: Task, folder: Path) -> Figures:
    """Do the work of a task; what cannot be read is not said to be what cannot be written."""
    try:
        return task.work(task.recording, folder)
    except OSError as error:
        raise ValueError(str(error)) from error


def perform_all(tasks: Sequence[Task], scheduler: str | None, workers: int | None) -> Performed:
    """The outcome of each task, as they come; close the iterator to stop all.

    Args:
        tasks: what is not done yet.
        scheduler: address of Dask's; None: processes of this machine.
        workers: so many of them at a time; None: one for each core.

    Raises:
        ClusterError: when no scheduler answers.
        ImportError: without Dask, for a scheduler.
    """
    if scheduler is None:
        return _perform_here(tasks, workers or len(os.sched_getaffinity(0)))
    return _perform_by_dask(tasks, scheduler)


def _perform_here(tasks: Sequence[Task], workers: int) -> Performed:
    """Outcomes of tasks, each in a process of its own: whatever ends it, the others go on."""
    context = multiprocessing.get_context("spawn")  # a fork would share threads that stand still
    waiting, running = deque(tasks), dict[Connection, tuple[Task, SpawnProcess]]()
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                ours, theirs = context.Pipe(duplex=False)
                process = context.Process(target=_perform_to, args=(theirs, waiting[0]))
                process.start()
                theirs.close()
                running[ours] = waiting.popleft(), process
            for ours in cast(list[Connection], wait(list(running))):
                task, process = running[ours]
                try:
                    outcome = ours.recv()
                    process.join()
                except EOFError:
                    process.join()
                    outcome = Outcome(None, f"lost: its process {_ended(process.exitcode)}")
                ours.close()
                del running[ours]
                yield task, outcome
    finally:
        for _, process in running.values():
            process.kill()  # who is asked to end goes on with its recording for seconds
            process.join()
        _clear(tasks)


def _perform_to(asked: Connection, task: Task) -> None:
    """Perform a task in a process of its own, which ends with the one that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's: all hear it, one decides
    parent = multiprocessing.parent_process()
    assert parent is not None
    end = functools.partial(wait, [parent.sentinel])
    threading.Thread(target=lambda: end() and os._exit(1), daemon=True).start()
    asked.send(perform(task))


def _ended(code: int | None) -> str:
    """How a process came to its end, by its exit code."""
    if code is None or code >= 0:
        return f"ended with exit code {code}"
    memory = ", as when memory runs out" if -code == signal.SIGKILL else ""
    return f"was ended by {signal.Signals(-code).name}{memory}"


def _perform_by_dask(tasks: Sequence[Task], scheduler: str) -> Performed:
    """Outcomes of tasks by a cluster; one that was lost with its worker is tried again, alone."""
    from distributed import Client, Future, KilledWorker, as_completed

    logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)
    try:
        client = Client(scheduler, timeout=_CONNECT_TIMEOUT)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ClusterError(f"no Dask scheduler answers at {scheduler}: {reason}") from error

    def ended(future: Future[Any]) -> Outcome | KilledWorker:
        try:
            return cast(Outcome, future.result())
        except KilledWorker as error:
            return error
        except Exception as error:  # with the scheduler, say
            return _lost(error)

    with client:
        # Not by what they are: a result that has been removed would be taken as done.
        futures = dict(zip(client.map(perform, tasks, pure=False), tasks, strict=True))
        killed = []
        for future in as_completed(list(futures)):
            if isinstance(end := ended(future), Outcome):
                yield futures[future], end
            else:
                killed.append(futures[future])
        # Dask blames all that waited at a worker for its end.
        for task in killed:
            end = ended(client.submit(perform, task, pure=False))
            _clear([task])
            yield task, end if isinstance(end, Outcome) else _lost(end)


def _lost(error: Exception) -> Outcome:
    return Outcome(None, f"lost: {' '.join(str(error).split())[:200]}")


def refuse_others(tasks: Sequence[Task]) -> None:
    """Raise ``ValueError`` for a folder that is there, and no result of its task."""
    resume_results(task.folder for task in tasks)
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
    """Outcome of each, by its folder; the summary in ``out`` is written however it ends.

    Args:
        heard: called as tasks end that had not been done before.

    Raises:
        ValueError: while another command is at it; as :func:`perform_all`.
    """
    with write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    with (out / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ValueError(f"another command is writing into {out}; wait for its end") from None
        outcomes = {
            task.folder: Outcome(known) for task in tasks if (known := finished(task)) is not None
        }
        waiting = [task for task in tasks if task.folder not in outcomes]
        try:
            with contextlib.closing(perform_all(waiting, scheduler, workers)) as performed:
                for task, outcome in performed:
                    outcomes[task.folder] = outcome
                    heard(task, outcome)
        finally:
            for task in tasks:  # what is done and has not been heard of, as after Ctrl-C
                known = finished(task)
                unheard = Outcome(known, "not done" if known is None else "")
                outcomes.setdefault(task.folder, unheard)
            _summarize(tasks, outcomes, out / SUMMARY)
    return outcomes


def _summarize(tasks: Sequence[Task], outcomes: Mapping[Path, Outcome], file: Path) -> None:
    """Write the table; it says the same whoever did the work, in whatever order it was done."""
    known = [outcomes[task.folder] for task in tasks]
    columns = list(dict.fromkeys(name for outcome in known for name in outcome.figures or ()))
    with atomic_files(file) as (part,), part.open("w", encoding="utf-8", newline="") as text:
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["recording", "folder", *columns, "reason"])
        for task, outcome in zip(tasks, known, strict=True):
            values = [(outcome.figures or {}).get(name, "") for name in columns]
            cells = [f"{v:.6g}" if isinstance(v, float) else str(v) for v in values]
            row = [str(task.recording), task.folder.name, *cells, outcome.reason]
            # Text that a spreadsheet does not take for a formula.
            writer.writerow([f"'{cell}" if cell[:1] in ("=", "+", "@") else cell for cell in row])


def _clear(tasks: Sequence[Task]) -> None:
    """Finish or remove what workers that were killed have left of these tasks."""
    for task in tasks:
        for folder in (task.folder.parent, task.folder):
            resume(folder)
