# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A real node in its own process, and a peer that talks to it over DDS."""

import contextlib
import fcntl
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

import rclpy
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter

# Nobody else's nodes, neither on this machine nor in its network.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

# s: what has not come by then hangs. It is told a little before the hour ends the test.
TIMEOUT = 3500.0
RUN = "import sys; from rs_localizer.ros.main import main; sys.exit(main())"


_unused = random.SystemRandom().sample(range(1, 101), 100)  # above 101 ports are taken by others


@contextlib.contextmanager
def _free_domain() -> Iterator[int]:
    """A domain that no process of pytest-xdist and no other run on this machine uses meanwhile."""
    while True:
        number = _unused.pop()
        path = Path(tempfile.gettempdir()) / f"rs_localizer_test_domain_{number}"
        with contextlib.ExitStack() as held:
            try:
                fcntl.flock(held.enter_context(path.open("w")), fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            yield number
            return


@pytest.fixture(scope="module", autouse=True)
def domain() -> Iterator[None]:
    """Each file its own: DDS goes on for a while to believe in nodes that another one killed."""
    with _free_domain() as number:
        os.environ["ROS_DOMAIN_ID"] = str(number)
        yield


# What a node writes comes at once, and stacks where it is aborted.
LOGGED = {"RCUTILS_LOGGING_BUFFERED_STREAM": "0", "PYTHONFAULTHANDLER": "1"}


class NodeProcess:
    def __init__(self, log: Path, *arguments: str, run: str, environment: dict[str, str]) -> None:
        self._log = log
        with log.open("w") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-c", run, "--ros-args", *arguments],
                stdout=file,
                stderr=file,
                env=os.environ | LOGGED | environment,
            )

    @property
    def log(self) -> str:
        return self._log.read_text()

    def wait_for_log(self, text: str) -> None:
        deadline = time.monotonic() + TIMEOUT
        while text not in self.log:
            assert self.process.poll() is None, self.log
            assert time.monotonic() < deadline, f"no {text!r} in:\n{self.log}"
            time.sleep(0.05)

    def stop(self, *signals: int) -> int:
        """Send signals one after the other and wait for the end: the exit code."""
        for number in signals or (signal.SIGINT,):
            self.process.send_signal(number)
            time.sleep(0.05)
        try:
            return self.process.wait(TIMEOUT)
        except subprocess.TimeoutExpired:
            self.process.send_signal(signal.SIGABRT)  # has all stacks written to the log
            self.process.wait()
            raise AssertionError(f"the node does not end:\n{self.log}") from None


class Peer:
    """A node of the test's own process, spun only while it waits."""

    def __init__(self) -> None:
        self._context = Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node("peer", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._clients: dict[str, Any] = {}

    def spin_until(self, condition: Callable[[], Any], timeout: float = TIMEOUT) -> bool:
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                return False
            self._executor.spin_once(timeout_sec=0.02)
        return True

    def call(self, service_type: Any, name: str, request: Any, harmless: Any = None) -> Any:
        """The answer of a service.

        The client knows when it has found the service; that the service has found the client, only
        its first answer tells. Until then answers are lost, so that the first request is repeated.

        Args:
            harmless: first request, if the other must not be repeated.
        """
        if name not in self._clients:
            self._clients[name] = client = self.node.create_client(service_type, name)
            assert self.spin_until(client.service_is_ready), f"no service {name}"
            first = harmless or request
            while not self.spin_until(client.call_async(first).done, 5.0):
                pass
        future = self._clients[name].call_async(request)
        assert self.spin_until(future.done), f"no answer from {name}"
        return future.result()

    def set(self, node: str, name: str, value: object) -> tuple[bool, str]:
        """Set a parameter of a node: whether it was, and the reason if not."""
        parameter = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[parameter])
        (result,) = self.call(SetParameters, f"{node}/set_parameters", request).results
        return result.successful, result.reason

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)


@pytest.fixture
def start_node(tmp_path) -> Iterator[Callable[..., NodeProcess]]:
    started: list[NodeProcess] = []

    def start(*arguments: str, run: str = RUN, **environment: str) -> NodeProcess:
        log = tmp_path / f"node{len(started)}.log"
        started.append(NodeProcess(log, *arguments, run=run, environment=environment))
        return started[-1]

    yield start
    for node in started:
        if node.process.poll() is None:
            node.process.kill()
            node.process.wait()


@pytest.fixture
def peer() -> Iterator[Peer]:
    result = Peer()
    yield result
    result.close()
