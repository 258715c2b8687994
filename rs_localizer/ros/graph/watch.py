"""Listens to a localizer node and writes how it is, again and again."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TextIO

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from rs_localizer.io import topics
from rs_localizer.io.outputs import TYPES
from rs_localizer.process.stopping import StopRequest
from rs_localizer.ros.graph.watched import Status, Values, Watched, euler, line, table

# Heard whatever the publisher offers.
_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
_ON_TERMINAL, _IN_LINES = 0.2, 1.0  # s from one look to the next
# How long a look may put off the end, in s.
_LATENCY = 0.1
_UP, _CLEAR = "\x1b[{}F", "\x1b[J"


def watch(name: str, output: TextIO, every: float | None = None) -> None:
    """Write until Ctrl-C or SIGTERM: a table in place on a terminal, else a line each time.

    Args:
        name: of the node, with its namespace.
        output: where to.
        every: s from one look to the next; None: as it suits the output.

    Raises:
        KeyboardInterrupt: at the end.
    """
    screen = _Screen(output) if output.isatty() else _Lines(output)
    with StopRequest() as stop:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        try:
            _run(name, screen.write, every or screen.period, lambda: stop.requested)
        finally:
            rclpy.try_shutdown()
        raise KeyboardInterrupt


def _run(
    name: str, write: Callable[[Watched, float], None], every: float, stopped: Callable[[], bool]
) -> None:
    node = rclpy.create_node(f"rs_localizer_watch_{os.getpid()}")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    watched = Watched(f"/{name.strip('/')}")
    _subscribe(node, watched)
    due = time.monotonic() + every
    while not stopped():
        executor.spin_once(timeout_sec=max(0.0, min(_LATENCY, due - time.monotonic())))
        if time.monotonic() >= due:
            watched.waiting = _why_silent(node, watched.node)
            write(watched, time.monotonic())
            due = max(due + every, time.monotonic())


def _subscribe(node: Any, watched: Watched) -> None:
    def take_pose(message: PoseWithCovarianceStamped) -> None:
        at = message.pose.pose
        turn = euler(np.append(_xyz(at.orientation), at.orientation.w))
        watched.arrived(_values(_xyz(at.position), turn, message.pose), time.monotonic())

    def take_twist(message: TwistWithCovarianceStamped) -> None:
        speed = message.twist.twist
        watched.twist = _values(_xyz(speed.linear), _xyz(speed.angular), message.twist)

    task = f"{watched.node.lstrip('/')}: localizer"

    def take_status(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == task:
                values = {item.key: item.value for item in status.values}
                watched.status = Status(int.from_bytes(status.level), status.message, values)

    for kind, topic, take in (
        (PoseWithCovarianceStamped, f"{watched.node}/{topics.POSE_WITH_COVARIANCE}", take_pose),
        (TwistWithCovarianceStamped, f"{watched.node}/{topics.TWIST_WITH_COVARIANCE}", take_twist),
        (DiagnosticArray, topics.DIAGNOSTICS, take_status),
    ):
        node.create_subscription(kind, topic, take, _QOS)


def _why_silent(node: Any, name: str) -> str:
    """What to say as long as no pose has come."""
    topic = f"{name}/{topics.POSE_WITH_COVARIANCE}"
    if node.count_publishers(topic):
        return ""
    end = f"/{topics.POSE_WITH_COVARIANCE}"
    kind = TYPES[topics.POSE_WITH_COVARIANCE]
    others = [
        found.removesuffix(end)
        for found, kinds in node.get_topic_names_and_types()
        if found.endswith(end) and kind in kinds and node.count_publishers(found)
    ]
    hint = f"; there is {', '.join(others)}" if others else ""
    return f"nobody publishes {topic} (ROS_DOMAIN_ID {os.environ.get('ROS_DOMAIN_ID', '0')}){hint}"


@dataclass(slots=True)
class _Lines:
    output: TextIO
    period: float = _IN_LINES

    def write(self, watched: Watched, now: float) -> None:
        self.output.write(f"{line(watched, now)}\n")
        self.output.flush()


@dataclass(slots=True)
class _Screen:
    output: TextIO
    period: float = _ON_TERMINAL
    _height: int = 0

    def write(self, watched: Watched, now: float) -> None:
        """Over what was written the last time."""
        width = shutil.get_terminal_size().columns - 1  # a line that wraps would be two
        lines = [text[:width] for text in table(watched, now)]
        up = _UP.format(self._height) if self._height else ""
        self.output.write(f"{up}{_CLEAR}" + "".join(f"{text}\n" for text in lines))
        self.output.flush()
        self._height = len(lines)


def _values(linear: np.ndarray, angular: np.ndarray, message: Any) -> Values:
    variances = np.diag(np.reshape(message.covariance, (6, 6)))
    return Values(linear, angular, np.sqrt(np.maximum(variances, 0.0)))


def _xyz(vector: Any) -> np.ndarray:
    return np.array([vector.x, vector.y, vector.z])
