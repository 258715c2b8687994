# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The tasks of many recordings, mapped by Dask or done here; finished ones are skipped."""

import contextlib
import io
import json
import logging
import socket
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

from rs_localizer.io.atomic_files import atomic_directory, content, write_errors
from rs_localizer.offline.tasks import (
    LOG,
    MARKER,
    SUMMARY,
    VERSION,
    Outcome,
    Task,
    finished,
    summarize,
)
from rs_localizer.process import ignore_working_folder

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


def perform_task(task: Task) -> Outcome:
    """Do a task, unless it has been done; its folder is there afterwards, whole, or not at all.

    Whatever goes wrong with the recording is an outcome, not an exception.
    """
    ignore_working_folder()  # of a worker of Dask, which another program has started
    here, said = socket.gethostname(), io.StringIO()
    if not task.settings.startswith(f"{VERSION} "):
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
    from distributed import Client, KilledWorker, LocalCluster, as_completed

    for name in _LOGGERS:
        logging.getLogger(name).setLevel(_SILENT)
    with contextlib.ExitStack() as stack:
        place = scheduler or stack.enter_context(LocalCluster(
            n_workers=workers, threads_per_worker=1, dashboard_address=None, preload=_PRELOAD,
            scheduler_kwargs={"allowed_failures": 0},
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
        summarize({task: outcomes[task.folder] for task in tasks}, out / SUMMARY)
    return outcomes
