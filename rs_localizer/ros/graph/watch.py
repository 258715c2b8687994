# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Listens to a localizer node and writes how it is, again and again."""

import os
import shutil
import time
import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TextIO

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.io import topics
from rs_localizer.io.outputs import TYPES
from rs_localizer.process.stopping import StopRequest
from rs_localizer.ros.node.conversion import xyz

# Rates are those of the last seconds; a pose that is older than this is said to be.
_WINDOW, _OLD = 5.0, 1.0
_LEVELS = ("ok", "warning", "error", "stale")
_WIDTH = 19


@dataclass(frozen=True, slots=True, eq=False)
class Values:
    """Six numbers of a message with covariance, linear ones first, and their deviations."""

    linear: Array  # (3,) m or m/s
    angular: Array  # (3,) rad, roll pitch yaw, or rad/s
    deviations: Array  # (6,)

    @property
    def spread(self) -> tuple[float, float]:
        """Root of the summed variances of the linear three, and of the angular ones in degrees."""
        linear, angular = self.deviations[:3], self.deviations[3:]
        return float(np.linalg.norm(linear)), float(np.degrees(np.linalg.norm(angular)))


@dataclass(frozen=True, slots=True)
class Status:
    """The node's entry of ``/diagnostics``."""

    level: int
    message: str
    values: dict[str, str]

    @property
    def state(self) -> str:
        return self.values.get("State", _LEVELS[min(self.level, 3)])

    @property
    def refusals(self) -> list[str]:
        """Why frames were refused, and how often."""
        start = "Refused: "
        counts = {k.removeprefix(start): v for k, v in self.values.items() if k.startswith(start)}
        return [f"{reason} {count}" for reason, count in counts.items()]


@dataclass(slots=True)
class Watched:
    """All that is known of a node; times are those of one steady clock, in s."""

    node: str
    pose: Values | None = None
    twist: Values | None = None
    status: Status | None = None
    waiting: str = ""  # why nothing comes; empty: somebody publishes
    _last: float = 0.0
    _arrivals: deque[float] = field(default_factory=deque)

    def arrived(self, pose: Values, now: float) -> None:
        self.pose, self._last = pose, now
        self._arrivals.append(now)

    def rate(self, now: float) -> float:
        """Poses per second."""
        while self._arrivals and self._arrivals[0] < now - _WINDOW:
            self._arrivals.popleft()
        count = len(self._arrivals)
        span = self._arrivals[-1] - self._arrivals[0] if count > 1 else 0.0
        return (count - 1) / span if span > 0.0 else 0.0

    def heading(self, now: float) -> str:
        """State and rate, or what is waited for."""
        if self.pose is None:
            return self.waiting or (self.status.state if self.status else "waiting for a pose")
        age = now - self._last
        late = f", no pose for {age:.1f} s" if age > _OLD else ""
        state = self.status.state if self.status else "localized"
        return f"{state}, {self.rate(now):.1f} Hz{late}"


def euler(quaternion: Array) -> Array:
    """Roll, pitch and yaw (3,) in rad about the fixed axes x, y, z (REP-103), of ``x y z w``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # looking straight up, roll counts as yaw
        angles: Array = Rotation.from_quat(quaternion).as_euler("xyz")
    return angles


def line(watched: Watched, now: float) -> str:
    """All in one line, for a log."""
    words = [watched.heading(now)]
    if (pose := watched.pose) is not None:
        words += [
            f"xyz {_three(pose.linear, 3)} m +-{1e3 * pose.spread[0]:.1f} mm",
            f"rpy {_three(np.degrees(pose.angular), 2)} +-{pose.spread[1]:.2f} deg",
        ]
    if (twist := watched.twist) is not None:
        words += [
            f"v {_three(twist.linear, 2)} +-{twist.spread[0]:.2f} m/s",
            f"w {_three(np.degrees(twist.angular), 1)} +-{twist.spread[1]:.1f} deg/s",
        ]
    if (status := watched.status) is not None:
        words += [f"{_LEVELS[min(status.level, 3)]}: {status.message}", *status.refusals]
    return " | ".join(words)


def table(watched: Watched, now: float) -> list[str]:
    """A line for each quantity, for a terminal."""
    lines = [f"{watched.node}: {watched.heading(now)}"]
    if (pose := watched.pose) is not None:
        degrees = np.degrees(pose.angular)
        lines += [
            _row("position (m)", _three(pose.linear, 3), f"{pose.spread[0]:.4f}"),
            _row("roll pitch yaw (deg)", _three(degrees, 2), f"{pose.spread[1]:.3f}"),
        ]
    if (twist := watched.twist) is not None:
        degrees = np.degrees(twist.angular)
        lines += [
            _row("linear (m/s)", _three(twist.linear, 3), f"{twist.spread[0]:.3f}"),
            _row("angular (deg/s)", _three(degrees, 2), f"{twist.spread[1]:.2f}"),
        ]
    if (status := watched.status) is not None:
        lines.append(f"{_LEVELS[min(status.level, 3)]}: {status.message}")
        if status.refusals:
            lines.append(f"refused: {', '.join(status.refusals)}")
    return lines


def _row(name: str, values: str, deviation: str) -> str:
    return f"{name:{_WIDTH + 2}} {values}  +- {deviation}"


def _three(values: Array, digits: int) -> str:
    return " ".join(f"{value:+{digits + 6}.{digits}f}" for value in values)


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
        turn = euler(np.append(xyz(at.orientation), at.orientation.w))
        watched.arrived(_values(xyz(at.position), turn, message.pose), time.monotonic())

    def take_twist(message: TwistWithCovarianceStamped) -> None:
        speed = message.twist.twist
        watched.twist = _values(xyz(speed.linear), xyz(speed.angular), message.twist)

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
        other.removesuffix(end)
        for other, kinds in node.get_topic_names_and_types()
        if other.endswith(end) and kind in kinds and node.count_publishers(other)
    ]
    hint = f"; there is {', '.join(others)}" if others else ""
    return f"no publisher on {topic} (ROS_DOMAIN_ID {os.environ.get('ROS_DOMAIN_ID', '0')}){hint}"


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
