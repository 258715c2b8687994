# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Processes that are killed in the middle of their work, and what becomes of it."""

import os
import socket
import subprocess
import sys
import threading
import time
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("distributed", reason="needs Dask")

from killing import kill

from rs_localizer.offline.fleet import cluster
from rs_localizer.offline.fleet.cluster import ClusterError, Where, perform_all
from rs_localizer.offline.fleet.task import PARTIAL, Kind, Outcome, Task, program


def tasks(tmp_path: Path, **contents: str) -> list[Task]:
    out = tmp_path / "out"
    out.mkdir()
    made = []
    for name, text in contents.items():
        (tmp_path / name).write_text(text)
        made.append(
            Task(
                Kind("kill", kill, "none"),
                Namespace(),
                tmp_path / name,
                out,
                name,
                f"identity of {name}",
                program(),
            )
        )
    return made


def check(done: list[Outcome], out: Path, failed: set[str]) -> None:
    """What has not failed is whole; of what has, nothing is left."""
    assert {outcome.name for outcome in done if outcome.figures is None} == failed
    for outcome in done:
        assert (out / outcome.name / "whole").exists() == (outcome.name not in failed)
    assert {path.name for path in out.iterdir()} - {PARTIAL} == {
        outcome.name for outcome in done
    } - failed


def test_a_recording_whose_worker_is_killed_is_done_by_another(tmp_path):
    given = tasks(tmp_path, good="", unlucky="me", deadly="me always", last="")
    done = list(perform_all(given, Where(workers=1)))
    assert sorted(outcome.name for outcome in done) == ["deadly", "good", "last", "unlucky"]
    check(done, tmp_path / "out", {"deadly"})
    (reason,) = [outcome.reason for outcome in done if outcome.name == "deadly"]
    assert reason == "every worker process that took it died (out of memory, or killed)"


def test_workers_that_dask_gives_up_are_replaced(tmp_path, monkeypatch):
    """Those of a machine that is too slow to start them again: nobody would do what is left."""
    made, local = [], cluster._local

    @contextmanager
    def seen(workers: int) -> Iterator[Any]:
        with local(workers) as found:
            made.append(found)
            yield found

    monkeypatch.setattr(cluster, "_local", seen)
    with subprocess.Popen(["sleep", "60"]) as victim:  # the second one takes a while
        given = tasks(tmp_path, first="", second=str(victim.pid), third="")
        outcomes = perform_all(given, Where(workers=1))
        done = [next(outcomes)]
        victim.wait()
    for nanny in made[0].workers.values():
        made[0].sync(nanny.close)
    done += outcomes
    assert len(made) == 2
    assert sorted(outcome.name for outcome in done) == ["first", "second", "third"]
    check(done, tmp_path / "out", set())


class Cluster:
    """A scheduler and a worker, as somebody starts them from a shell."""

    def __init__(self, port: int) -> None:
        self.address = f"tcp://127.0.0.1:{port}"
        where = ["--host", "127.0.0.1", "--no-dashboard"]
        self._processes = [
            _start("dask_scheduler", "--port", str(port), *where),
            _start("dask_worker", self.address, "--nthreads", "1", "--no-nanny", *where),
        ]
        self.scheduler = self._processes[0]

    def end(self) -> None:
        for process in self._processes:
            process.kill()
            process.wait(60)


def _start(name: str, *words: str) -> subprocess.Popen[bytes]:
    here = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-m", f"distributed.cli.{name}", *words],
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": here},
    )


def test_a_scheduler_that_is_killed_and_comes_back_goes_on(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    clusters = [Cluster(port)]

    def restart() -> None:
        clusters[0].scheduler.wait()
        clusters[0].end()
        clusters.append(Cluster(port))

    operator = threading.Thread(target=restart, daemon=True)
    operator.start()
    victim = str(clusters[0].scheduler.pid)
    given = tasks(tmp_path, first="", second=victim, third="")
    try:
        _wait_for(port)
        done = list(perform_all(given, Where(scheduler=clusters[0].address)))
        operator.join(60)
    finally:
        clusters[-1].end()
    assert len(clusters) == 2
    assert sorted(outcome.name for outcome in done) == ["first", "second", "third"]
    check(done, tmp_path / "out", set())


def _wait_for(port: int) -> None:
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        with socket.socket() as knocking:
            if knocking.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.1)


def test_an_address_without_a_scheduler_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "_CONNECT_TIMEOUT", 0.5)
    with pytest.raises(ClusterError, match="no Dask scheduler answers at tcp://"):
        list(perform_all(tasks(tmp_path, one=""), Where(scheduler="tcp://127.0.0.1:9")))
