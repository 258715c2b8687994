# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Plays the messages of a recording into the ROS graph, with /clock."""

import time
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

from rs_localizer.io import topics
from rs_localizer.io.outputs import TYPES
from rs_localizer.process.stopping import StopSignals
from rs_localizer.ros.node.conversion import copy_message, message_class
from rs_localizer.settings import NODE_NAME

_CLOCK_PERIOD = 0.01  # s of real time between two messages on /clock
_DISCOVERY_TIMEOUT = 5.0  # s to wait for somebody who listens
_SETTLING_TIME = 0.3  # s to be heard by those whom we hear, and the other way round
_REST_TIME = 0.5  # s to wait for the last answers
# Reliable publishers are heard by reliable and by best-effort subscribers.
_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
_LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
# As tf2_ros has them; whether anybody listens depends on the node's settings.
_TF_QOS = {
    topics.TF: QoSProfile(depth=100),
    topics.TF_STATIC: QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL),
}


_POSE = f"/{NODE_NAME}/{topics.POSE}"


class PlayerError(ValueError):
    """Nobody listens."""


@dataclass(frozen=True, slots=True)
class Played:
    """What came of it."""

    seconds: float  # from the first message to the last
    poses: dict[str, int]  # how many were heard, by the topic of each localizer node


def play(
    messages: Iterable[tuple[str, int, Any]],
    types: Mapping[str, str],
    rate: float = 1.0,
    latched: Collection[str] = (),
) -> Played:
    """Publish messages at the pace of their recording.

    Args:
        messages: topic, time of recording in ns, message of rosbags; in the order of time.
        types: type name of each topic.
        rate: times real time.
        latched: topics of which who comes late hears the last message, too.

    Raises:
        PlayerError: when nobody listens to any of the topics.
    """
    with StopSignals():
        # rclpy's own handlers end the context from a thread while the player still uses it.
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        try:
            return _play(messages, types, rate, latched)
        finally:
            rclpy.try_shutdown()


def _play(
    messages: Iterable[tuple[str, int, Any]],
    types: Mapping[str, str],
    rate: float,
    latched: Collection[str],
) -> Played:
    node = rclpy.create_node("rs_localizer_player")
    clock = node.create_publisher(Clock, "/clock", _QOS)
    qos = _TF_QOS | dict.fromkeys(latched, _LATCHED)
    publishers = {
        topic: node.create_publisher(message_class(name), topic, qos.get(topic, _QOS))
        for topic, name in types.items()
    }
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    _wait_for_listeners(node, {t: p for t, p in publishers.items() if t not in _TF_QOS})
    poses = _Poses(node)
    poses.look_round()
    _listen(executor, _SETTLING_TIME)
    started: tuple[float, int] | None = None
    for topic, recorded_ns, message in messages:
        poses.look_round()
        if started is None:
            started = time.monotonic(), recorded_ns
        due = started[0] + (recorded_ns - started[1]) * 1e-9 / rate
        while (seconds_left := due - time.monotonic()) > 0.0:
            _tick(clock, recorded_ns - round(seconds_left * rate * 1e9))
            _listen(executor, min(seconds_left, _CLOCK_PERIOD))
        _tick(clock, recorded_ns)
        publishers[topic].publish(copy_message(message, types[topic]))
    for publisher in publishers.values():
        publisher.wait_for_all_acked(Duration(seconds=1.0))
    seconds = 0.0 if started is None else time.monotonic() - started[0]
    _listen(executor, _REST_TIME)
    return Played(seconds, dict(poses.counts))


class _Poses:
    """Counts the poses of all localizer nodes, by topic."""

    def __init__(self, node: Any) -> None:
        self.counts: Counter[str] = Counter()
        self._node = node

    def look_round(self) -> None:
        """Hear nodes that are new in the graph, too: they are discovered one after the other."""
        for topic, types in self._node.get_topic_names_and_types():
            if topic.endswith(_POSE) and types == [TYPES[topics.POSE]]:
                self._hear(topic)

    def _hear(self, topic: str) -> None:
        if topic not in self.counts:
            self.counts[topic] = 0
            self._node.create_subscription(
                PoseStamped, topic, lambda _: self.counts.update((topic,)), _QOS
            )


def _listen(executor: SingleThreadedExecutor, seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while (seconds_left := deadline - time.monotonic()) > 0.0:
        executor.spin_once(timeout_sec=seconds_left)


def _wait_for_listeners(node: Any, publishers: Mapping[str, Any]) -> None:
    """Messages published before the subscribers are discovered would be lost."""
    deadline = time.monotonic() + _DISCOVERY_TIMEOUT
    while deaf := [t for t, p in publishers.items() if p.get_subscription_count() == 0]:
        if time.monotonic() > deadline:
            if len(deaf) == len(publishers):
                raise PlayerError(
                    f"nobody subscribes to {' and '.join(deaf)}: start the node, or check its "
                    "topics and ROS_DOMAIN_ID"
                )
            node.get_logger().warning(f"nobody subscribes to {', '.join(deaf)}")
            return
        time.sleep(0.05)


def _tick(clock: Any, now_ns: int) -> None:
    seconds, nanoseconds = divmod(now_ns, 1_000_000_000)
    clock.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
