# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run rs_localizer example_matcher``: the bundled webcam recording, as a matcher publishes.

It answers a localizer without a matcher of one's own: matches and camera_info at the pace of the
recording, over and over; poses and twists that come back are printed. Yours is written like
``examples/03_node_client.py``.
"""

from __future__ import annotations

import itertools
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions

from rs_localizer import data
from rs_localizer.io import topics
from rs_localizer.io.bags import open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.recording import CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC
from rs_localizer.process.stopping import StopRequest
from rs_localizer.ros.node.conversion import copy_message, message_class
from rs_localizer.settings import NODE_NAME

_PERIOD_NS = 33_333_333  # between the end of the recording and its next beginning


class ExampleMatcher(Node):
    """Publishes each image's matches when it is due, with stamps of now."""

    def __init__(self, **options: Any) -> None:
        super().__init__("example_matcher", **options)
        wanted = {
            CAMERA_INFO_TOPIC: topics.CAMERA_INFO,
            CORRESPONDENCES_TOPIC: topics.CORRESPONDENCES,
        }
        with open_bag(data.path(data.WEBCAM)) as bag:
            kinds = {topic: bag.topics[topic] for topic in wanted}
            self._messages = [
                (wanted[topic], copy_message(message, kinds[topic]))
                for topic, _, message in bag.messages(wanted)
            ]
        self._out = {
            name: self.create_publisher(message_class(kinds[topic]), name, qos_profile_sensor_data)
            for topic, name in wanted.items()
        }
        for name, kind in ((topics.POSE, PoseStamped), (topics.TWIST, TwistStamped)):
            self.create_subscription(kind, f"{NODE_NAME}/{name}", self._tell, 10)
        self._due = self._schedule()
        self._next = next(self._due)
        self.create_timer(0.005, self._publish)
        self.get_logger().info(
            f"publishing {' and '.join(wanted.values())}; start a localizer: ros2 run rs_localizer "
            "localizer --ros-args -p readout_time:=0.011"
        )

    def _schedule(self) -> Any:
        """Yield times (ns) at which messages are due, topics and messages, for ever."""
        stamps = [stamp_ns(message) for _, message in self._messages]
        length = stamps[-1] - stamps[0] + _PERIOD_NS
        start = self.get_clock().now().nanoseconds + 10**9 - stamps[0]
        for turn in itertools.count():
            for stamp, (name, message) in zip(stamps, self._messages, strict=True):
                yield stamp + start + turn * length, name, message

    def _publish(self) -> None:
        now = self.get_clock().now().nanoseconds
        while self._next[0] <= now:
            due, name, message = self._next
            message.header.stamp = Time(sec=due // 10**9, nanosec=due % 10**9)
            self._out[name].publish(message)
            self._next = next(self._due)

    def _tell(self, message: PoseStamped | TwistStamped) -> None:
        say = self.get_logger().info  # which throttles each line of code on its own
        if isinstance(message, PoseStamped):
            p, q = message.pose.position, message.pose.orientation
            values = _text(p.x, p.y, p.z, q.x, q.y, q.z, q.w)
            say(f"pose x y z (m), qx qy qz qw: {values}", throttle_duration_sec=0.5)
        else:
            w, v = message.twist.angular, message.twist.linear
            values = _text(w.x, w.y, w.z, v.x, v.y, v.z)
            say(f"twist wx wy wz (rad/s), vx vy vz (m/s): {values}", throttle_duration_sec=0.5)


def _text(*numbers: float) -> str:
    return " ".join(f"{number:+.3f}" for number in numbers)


def run(stop: StopRequest, args: list[str] | None = None) -> int:
    """Publish until ``stop`` is requested; the exit code."""
    # rclpy's own handlers end the context from a thread while the node still publishes.
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    node = ExampleMatcher()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not stop.requested:
        executor.spin_once()  # returns after each of the timer's calls
    node.destroy_node()
    rclpy.try_shutdown()
    return 0
