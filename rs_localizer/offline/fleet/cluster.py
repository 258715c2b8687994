# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Tasks by Dask: on a cluster of this machine, or by a scheduler that runs already."""

import contextlib
import logging
import os
import signal
import time
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

from rs_localizer.offline.fleet.task import Outcome, Task, perform

# How often a recording may take its worker with it until it counts as failed.
_DEATHS = 3
# How long a scheduler that is gone may take to come back, in s, and how often it is looked for.
_PATIENCE, _PERIOD = 60.0, 1.0
# How often in a row all tasks may be given out without a single outcome.
_ROUNDS = 5
_CONNECT_TIMEOUT = 5.0
# How often it is looked whether a task has ended, in s.
_LOOK_PERIOD = 0.02


class ClusterError(ValueError):
    """No workers; the message says why."""


@dataclass(frozen=True, slots=True)
class Where:
    """Who does the work: a scheduler's workers, or so many processes of this machine."""

    scheduler: str | None = None
    workers: int | None = None  # None: one for each core

    def processes(self, tasks: int) -> int:
        """How many of this machine."""
        return max(1, min(tasks, self.workers or len(os.sched_getaffinity(0))))


def perform_all(tasks: Sequence[Task], where: Where) -> Generator[Outcome, None, None]:
    """The outcome of each task, as they come; close the iterator to stop all.

    A task whose worker is lost is done by another one, one whose scheduler is lost when it is back.

    Raises:
        ClusterError: when no scheduler answers.
        ImportError: without Dask.
    """
    if not tasks:
        return
    _silence()
    remaining = {task.name: task for task in tasks}
    patience, idle = 0.0, 0
    while remaining:
        before = len(remaining)
        try:
            with _cluster(where, before) as cluster:
                yield from _all_done(remaining, cluster, patience)
        except ClusterError as error:
            if not patience:
                raise
            yield from _given_up(remaining, str(error))
            return
        # What is left was lost on its way, with the scheduler, or because no worker of this
        # machine was left: who has done it, tells again.
        patience, idle = _PATIENCE, idle + 1 if len(remaining) == before else 0
        if idle == _ROUNDS:
            yield from _given_up(remaining, "the scheduler never answers with its result")
            return


def _given_up(names: Iterable[str], reason: str) -> Iterator[Outcome]:
    return (Outcome(name, None, reason) for name in names)


def _cluster(where: Where, tasks: int) -> AbstractContextManager[Any]:
    """What a client connects to."""
    if where.scheduler is not None:
        _check_address(where.scheduler)
        return contextlib.nullcontext(where.scheduler)
    return _local(where.processes(tasks))


def _check_address(address: str) -> None:
    """Refuse what is none: a client would, too, and then wait for itself with a traceback."""
    from distributed.comm.addressing import get_address_host_port

    try:
        get_address_host_port(address)
    except ValueError as error:
        raise ClusterError(
            f"--scheduler needs an address such as tcp://host:8786, got {address!r}: {error}"
        ) from error


def _all_done(remaining: dict[str, Task], cluster: Any, patience: float = 0.0) -> Iterator[Outcome]:
    """The outcomes of tasks, each of which is taken out of ``left``; some may be lost."""
    with _client(cluster, patience) as client:
        # Not by what they are: a result that has been removed meanwhile would be taken as done.
        tasks = list(remaining.values())
        futures = dict(zip(client.map(perform, tasks, pure=False), tasks, strict=True))
        for future in _as_they_end(list(futures), client, cluster):
            task = futures.pop(future)
            try:
                outcome = _outcome(task, future)
            except (CancelledError, OSError):  # the scheduler is gone, or who has the outcome
                continue
            del remaining[task.name]
            yield outcome


def _as_they_end(futures: Sequence[Any], client: Any, cluster: Any) -> Iterator[Any]:
    """Futures that have ended, however; no more once no worker of this machine is left.

    Dask starts a worker again that has died, but gives it up if it takes too long to come.
    """
    from distributed import as_completed

    ended, remaining = as_completed(futures, loop=client.loop), len(futures)
    while remaining:
        batch = ended.next_batch(block=False)
        remaining -= len(batch)
        yield from batch
        if not batch:
            if _deserted(cluster):
                return
            time.sleep(_LOOK_PERIOD)


def _deserted(cluster: Any) -> bool:
    """Whether all workers of this machine have been given up; those of a scheduler are its own."""
    from distributed import LocalCluster, Status

    if not isinstance(cluster, LocalCluster):
        return False
    given_up = (Status.closing, Status.closed, Status.failed)
    return all(nanny.status in given_up for nanny in list(cluster.workers.values()))


def _silence() -> None:
    """What Dask logs of workers and schedulers that are lost is told in the outcomes."""
    import distributed  # gives some of its loggers levels of their own

    known = [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    for name in (distributed.__name__, *known):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def _outcome(task: Task, future: Any) -> Outcome:
    from distributed import KilledWorker

    if future.status != "error":
        outcome: Outcome = future.result(timeout=_CONNECT_TIMEOUT)
        return outcome
    error = future.exception()
    if isinstance(error, KilledWorker):
        reason = "every worker process that took it died (out of memory, or killed)"
        return Outcome(task.name, None, reason)
    return Outcome(task.name, None, f"{type(error).__name__}: {' '.join(str(error).split())}")


@contextlib.contextmanager
def _client(cluster: Any, patience: float) -> Iterator[Any]:
    from distributed import Client

    deadline = time.monotonic() + patience
    while True:
        try:
            client = Client(cluster, timeout=_CONNECT_TIMEOUT, set_as_default=False)
            break
        except (OSError, ValueError, ImportError) as error:
            if time.monotonic() < deadline:
                time.sleep(_PERIOD)
                continue
            raise ClusterError(
                f"no Dask scheduler answers at {cluster}: {' '.join(str(error).split())}"
            ) from error
    with client:
        yield client


@contextlib.contextmanager
def _local(workers: int) -> Iterator[Any]:
    """A cluster of processes with one thread each."""
    import dask
    from distributed import LocalCluster

    settings = {
        "distributed.scheduler.allowed-failures": _DEATHS - 1,
        # A worker that dies takes no task along but the one that it is at.
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.worker.preload": ["rs_localizer.offline.fleet.cluster"],
        # Nobody looks at what Dask samples of the work every 10 ms.
        "distributed.worker.profile.enabled": False,
    }
    # Of worker processes that were killed, Python's clean-up would tell on the screen.
    quiet = "ignore:resource_tracker:UserWarning"
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, [os.environ.get("PYTHONWARNINGS"), quiet]))
    with dask.config.set(settings):
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=0,  # the operating system's
            dashboard_address="127.0.0.1:0",  # any free port, for nobody else
            silence_logs=logging.CRITICAL + 1,
        )
        try:
            yield cluster
        except BaseException:
            _kill(cluster)
            raise
        finally:
            with contextlib.suppress(Exception):
                cluster.close(timeout=5)


def _kill(cluster: Any) -> None:
    """End workers at once: one that is asked goes on with its recording for seconds."""
    for nanny in cluster.workers.values():
        with contextlib.suppress(AttributeError, ProcessLookupError, TypeError):
            os.kill(nanny.process.pid, signal.SIGKILL)


def dask_setup(worker: Any) -> None:
    """Leave Ctrl-C, which a terminal sends to all processes, to the one that started them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
