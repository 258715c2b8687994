# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A live localizer node in a process of its own, that gets frames and answers them."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, PointCloud2

from rs_localizer.io import topics
from rs_localizer.io.messages import stamp_ns
from rs_localizer.process.stopping import StopSignals
from rs_localizer.ros.node.conversion import copy_message
from rs_localizer.settings import NODE_NAME

# The installed executable may not be on the path; this starts the same node.
_NODE = "import sys; from rs_localizer.ros.main import main; sys.exit(main())"
_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
_MANY = QoSProfile(depth=200, reliability=ReliabilityPolicy.RELIABLE)
# Frames that will never be answered, by the node's diagnostics.
_UNANSWERED = ("Frames refused", "Frames replaced", "Frames dropped")
# s without a word on topics and in the log: a node says how it is once a second. A busy machine
# may take minutes to start one.
_SILENCE = 300.0
_SETTLING = 1.0  # s for endpoints to find each other both ways
_LOST = 3  # words of the node, once a second, without a frame that it was sent
_STOP_TIMEOUT = 10.0
_LAST_LINES = 5


class LiveError(ValueError):
    """A node that died or fell silent."""


class LiveNode:
    """A localizer node; a context manager that leaves no process behind.

    There is no limit of time as long as the node lives and says how it is.

    Args:
        settings: its parameters.
        log: file for its log.
        delay_ns: time from the stamp of a frame to the stamp of its pose, by these settings.
    """

    def __init__(self, settings: Mapping[str, Any], log: Path, delay_ns: int) -> None:
        self._settings, self._log, self._delay_ns = settings, log, delay_ns
        self._signals = StopSignals()
        # No one else's nodes shall hear these frames, or be heard.
        self.namespace = f"/demo_{os.getpid()}"
        self._poses: dict[int, PoseStamped] = {}
        self._status: dict[str, str] = {}
        self._others: dict[str, Any] = {}
        self._words = 0  # of the diagnostics
        self._heard = time.time()

    def __enter__(self) -> Self:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        self._process: subprocess.Popen[bytes] | None = None
        self._signals.__enter__()
        try:
            self._start()
        except BaseException as error:
            self.__exit__(None, error, None)
            raise
        return self

    def _start(self) -> None:
        rclpy.init()
        self._node = node = rclpy.create_node("demo", namespace=self.namespace)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        pose = f"{self.namespace}/{NODE_NAME}/{topics.POSE}"
        node.create_subscription(PoseStamped, pose, self._take_pose, _QOS)
        node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, self._take_status, _QOS)
        self._publishers = (
            node.create_publisher(CameraInfo, topics.CAMERA_INFO, _QOS),
            node.create_publisher(PointCloud2, topics.CORRESPONDENCES, _QOS),
        )
        words = ["-r", f"__ns:={self.namespace}"]
        words += [
            word for name, value in self._settings.items() for word in ("-p", f"{name}:={value}")
        ]
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _NODE, "--ros-args", *words],
                stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
            )  # fmt: skip

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        try:
            if self._process is not None:
                self._process.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(_STOP_TIMEOUT)
        finally:
            if self._process is not None:
                self._process.kill()
                self._process.wait()
            rclpy.try_shutdown()
            self._signals.__exit__()
        if error is not None and self._signals.requested:
            # A signal also ends the context, and with it whatever call is under way.
            raise KeyboardInterrupt from error

    @property
    def pid(self) -> int:
        """Number of the node's process."""
        assert self._process is not None
        return self._process.pid

    def publisher(self, kind: type, topic: str) -> Any:
        """Return a publisher on another of the node's inputs, made on first use."""
        if topic not in self._others:
            name = f"{self.namespace}/{topic}"
            self._others[topic] = self._node.create_publisher(kind, name, _MANY)
        return self._others[topic]

    def wait(self, tell: Callable[[str], object]) -> None:
        """Wait until the node is active and heard; ``tell`` gets its last line meanwhile.

        Raises:
            LiveError: when it died or fell silent, with the last lines of its log.
        """
        said = ""

        def ready() -> bool:
            nonlocal said
            lines = self._lines()
            if lines and lines[-1] != said:
                said = lines[-1]
                tell(said)
            listening = all(p.get_subscription_count() for p in self._publishers)
            return listening and self._words > 0

        self._until(ready)
        deadline = time.monotonic() + _SETTLING
        self._until(lambda: time.monotonic() > deadline)

    def send(self, info: Any, cloud: Any) -> None:
        """Publish a frame, and wait for nothing."""
        to_info, to_cloud = self._publishers
        to_info.publish(copy_message(info, "sensor_msgs/msg/CameraInfo"))
        to_cloud.publish(copy_message(cloud, "sensor_msgs/msg/PointCloud2"))

    def localize(self, info: Any, cloud: Any) -> PoseStamped | None:
        """Return the node's answer to a frame; None if the node has refused it.

        Raises:
            LiveError: as :meth:`wait`.
        """
        stamp, before = stamp_ns(cloud), self._unanswered
        while True:
            received, words = self._count("Frames received"), self._words
            self.send(info, cloud)

            def answered() -> bool:
                return stamp in self._poses or self._unanswered > before

            def lost() -> bool:
                silent = self._words >= words + _LOST  # noqa: B023
                return silent and self._count("Frames received") == received  # noqa: B023

            self._until(lambda: answered() or lost())
            if answered():
                return self._poses.get(stamp)

    @property
    def _unanswered(self) -> int:
        return sum(self._count(name) for name in _UNANSWERED)

    def _count(self, name: str) -> int:
        return int(self._status.get(name, 0))

    def _take_pose(self, message: PoseStamped) -> None:
        self._poses[stamp_ns(message) - self._delay_ns] = message
        self._heard = time.time()

    def _take_status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == f"{self.namespace.lstrip('/')}/{NODE_NAME}: localizer":
                self._status = {item.key: item.value for item in status.values}
                self._words += 1
                self._heard = time.time()

    def _lines(self) -> list[str]:
        return self._log.read_text(errors="replace").strip().splitlines()

    def _until(self, condition: Callable[[], bool]) -> None:
        assert self._process is not None
        while not condition():
            self._executor.spin_once(timeout_sec=0.05)
            code = self._process.poll()
            silence = time.time() - max(self._heard, self._log.stat().st_mtime)
            if code is None and silence < _SILENCE:
                continue
            fate = f"has said nothing for {silence:.0f} s" if code is None else f"ended with {code}"
            last = "\n  ".join(self._lines()[-_LAST_LINES:] or ["nothing"])
            raise LiveError(f"the node {fate}; the last lines of its log:\n  {last}")
