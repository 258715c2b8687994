"""Plays the messages of a recording into the ROS graph, with /clock."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable, Mapping
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from rclpy.duration import Duration
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from rs_localizer.ros.conversion import copy_message, message_class
from rs_localizer.stopping import StopSignals

_CLOCK_PERIOD = 0.01  # s of real time between two messages on /clock
_DISCOVERY_TIMEOUT = 5.0  # s to wait for somebody who listens
# Reliable publishers are heard by reliable and by best-effort subscribers.
_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


def play(
    messages: Iterable[tuple[str, int, Any]], types: Mapping[str, str], rate: float = 1.0
) -> None:
    """Publish messages at the pace of their recording.

    Args:
        messages: topic, time of recording in ns, message of rosbags; in the order of time.
        types: type name of each topic.
        rate: times real time.
    """
    with StopSignals():
        rclpy.init()
        try:
            _play(messages, types, rate)
        finally:
            # After a signal rclpy does the same in a thread, and whoever comes second fails.
            with contextlib.suppress(RuntimeError):
                rclpy.try_shutdown()


def _play(messages: Iterable[tuple[str, int, Any]], types: Mapping[str, str], rate: float) -> None:
    node = rclpy.create_node("rs_localizer_player")
    clock = node.create_publisher(Clock, "/clock", _QOS)
    publishers = {
        topic: node.create_publisher(message_class(name), topic, _QOS)
        for topic, name in types.items()
    }
    _wait_for_listeners(node, publishers)
    started: tuple[float, int] | None = None
    for topic, recorded_ns, message in messages:
        if started is None:
            started = time.monotonic(), recorded_ns
        due = started[0] + (recorded_ns - started[1]) * 1e-9 / rate
        while (left := due - time.monotonic()) > 0.0:
            _tick(clock, recorded_ns - round(left * rate * 1e9))
            time.sleep(min(left, _CLOCK_PERIOD))
        _tick(clock, recorded_ns)
        publishers[topic].publish(copy_message(message, types[topic]))
    for publisher in publishers.values():
        publisher.wait_for_all_acked(Duration(seconds=1.0))


def _wait_for_listeners(node: Any, publishers: Mapping[str, Any]) -> None:
    """Messages published before the subscribers are discovered would be lost."""
    deadline = time.monotonic() + _DISCOVERY_TIMEOUT
    while deaf := [t for t, p in publishers.items() if p.get_subscription_count() == 0]:
        if time.monotonic() > deadline:
            node.get_logger().warning(f"nobody listens to {', '.join(deaf)}")
            return
        time.sleep(0.05)


def _tick(clock: Any, now_ns: int) -> None:
    seconds, nanoseconds = divmod(now_ns, 1_000_000_000)
    clock.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
