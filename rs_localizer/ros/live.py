# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The localizer node on a graph of its own, that gets frames through DDS and answers them."""

import os
import time
from collections.abc import Callable, Mapping
from typing import Any, Self

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.logging import LoggingSeverity
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, PointCloud2

from rs_localizer.io import topics
from rs_localizer.io.messages import stamp_ns
from rs_localizer.ros.localizer.node import LocalizerNode
from rs_localizer.ros.node.conversion import copy_message
from rs_localizer.ros.node.managed import executor_of
from rs_localizer.ros.node.statistics import Event
from rs_localizer.settings import NODE_NAME

_UNANSWERED = Event.REFUSED, Event.REPLACED, Event.DROPPED
_TOO_LONG = 60.0  # s after which there is no answer
_SETTLING = 1.0  # s for endpoints to find each other both ways


class LiveNode:
    """A localizer and a peer that sends to it; a context manager.

    Args:
        settings: its parameters, with a readout_time, and poses of the middle row.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self._settings, self._delay_ns = settings, round(0.5e9 * settings["readout_time"])
        self._poses: dict[int, PoseStamped] = {}

    def __enter__(self) -> Self:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        try:
            self._start()
        except BaseException:
            rclpy.try_shutdown()
            raise
        return self

    def _start(self) -> None:
        space = f"/demo_{os.getpid()}"  # no one else's nodes shall hear these frames, or be heard
        given = [Parameter(name, value=value) for name, value in self._settings.items()]
        self._node = LocalizerNode(namespace=space, parameter_overrides=given)
        self._node.get_logger().set_level(LoggingSeverity.ERROR)
        peer = rclpy.create_node("demo", namespace=space)
        pose = f"{NODE_NAME}/{topics.POSE}"
        heard = peer.create_subscription(PoseStamped, pose, self._take_pose, 10)
        self._publishers = (
            peer.create_publisher(CameraInfo, topics.CAMERA_INFO, 10),
            peer.create_publisher(PointCloud2, topics.CORRESPONDENCES, 10),
        )
        self._executor = executor_of(rclpy.get_default_context())
        for each in (self._node, peer):
            self._executor.add_node(each)
        for trigger in (self._node.trigger_configure, self._node.trigger_activate):
            if trigger() != TransitionCallbackReturn.SUCCESS:
                raise ValueError("the node does not start: see its log")
        ends = [each.get_subscription_count for each in self._publishers]
        ends.append(lambda: peer.count_publishers(heard.topic_name))
        self._until(lambda: all(count() for count in ends))
        deadline = time.monotonic() + _SETTLING
        self._until(lambda: time.monotonic() > deadline)

    def __exit__(self, *_: object) -> None:
        self._node.destroy_node()
        rclpy.try_shutdown()

    def localize(self, info: Any, cloud: Any) -> PoseStamped | None:
        """Return the node's answer to a frame; None if the node has refused it.

        Raises:
            ValueError: when there is none.
        """
        stamp, before = stamp_ns(cloud), self._unanswered
        to_info, to_cloud = self._publishers
        to_info.publish(copy_message(info, "sensor_msgs/msg/CameraInfo"))
        to_cloud.publish(copy_message(cloud, "sensor_msgs/msg/PointCloud2"))
        self._until(lambda: stamp in self._poses or self._unanswered > before)
        return self._poses.get(stamp)

    @property
    def _unanswered(self) -> int:
        total = self._node.statistics.summary().total
        return sum(total.get(event, 0) for event in _UNANSWERED)

    def _take_pose(self, message: PoseStamped) -> None:
        self._poses[stamp_ns(message) - self._delay_ns] = message

    def _until(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + _TOO_LONG
        while not condition():
            self._executor.spin_once(timeout_sec=0.05)
            if time.monotonic() > end:
                raise ValueError(f"the node has not answered for {_TOO_LONG:.0f} s: see its log")
