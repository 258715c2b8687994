# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Records what a live node publishes, for the picture of RViz in README.

    python docs/rviz.py run.bag

The node runs as a process of its own and gets the bundled webcam recording over DDS, once, at its
pace. What it publishes goes to a bag of ROS 1, because Debian packages RViz for ROS 1 only:

    roscore &
    rosrun tf static_transform_publisher 0 0 0 0 0 0 map board 100 &
    rviz -d docs/rviz.rviz &
    rosbag play run.bag

``config/rs_localizer.rviz`` shows the same topics in RViz 2.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from rs_localizer import data
from rs_localizer.io import topics
from rs_localizer.io.bags import open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import TYPES
from rs_localizer.io.recording import CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC
from rs_localizer.ros.node.conversion import copy_message, message_class
from rs_localizer.settings import NODE_NAME

SENT = {CAMERA_INFO_TOPIC: topics.CAMERA_INFO, CORRESPONDENCES_TOPIC: topics.CORRESPONDENCES}
KEPT = {**TYPES, topics.CAMERA_MARKER: "visualization_msgs/msg/MarkerArray"}
NOETIC = get_typestore(Stores.ROS1_NOETIC)
START, END = 20.0, 1.0  # s, most that a node needs to start; to answer after the last message


def as_ros1(message: Any, kind: str) -> Any:
    """Return a message of ROS 2 as rosbags writes it in ROS 1; it has a `seq` that ROS 2 lacks."""
    made = {}
    for name, (shape, of) in NOETIC.fielddefs[kind][1]:
        value = getattr(message, name, 0)
        if shape == Nodetype.NAME:
            value = as_ros1(value, of)
        elif shape == Nodetype.SEQUENCE and of[0][0] == Nodetype.NAME:
            value = [as_ros1(each, of[0][1]) for each in value]
        elif shape in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            value = np.asarray(value, of[0][1][0])
        made[name] = value
    return NOETIC.types[kind](**made)


class Run(Node):
    """Sends the bundled recording once and keeps what the localizer publishes."""

    def __init__(self) -> None:
        super().__init__("rviz_recorder")
        with open_bag(data.path(data.WEBCAM)) as bag:
            kinds = {topic: bag.topics[topic] for topic in SENT}
            self.messages = [
                (SENT[topic], copy_message(message, kinds[topic]))
                for topic, _, message in bag.messages(SENT)
            ]
        self.out = {
            name: self.create_publisher(message_class(kinds[topic]), name, qos_profile_sensor_data)
            for topic, name in SENT.items()
        }
        self.kept: list[tuple[int, str, Any]] = []
        for name, kind in KEPT.items():
            self.create_subscription(
                message_class(kind), f"{NODE_NAME}/{name}",
                lambda message, name=name: self.kept.append((time.time_ns(), name, message)), 100,
            )  # fmt: skip

    def run(self) -> None:
        """Send each message when it is due, from when the localizer listens."""
        end = time.monotonic() + START
        while not all(each.get_subscription_count() for each in self.out.values()):
            if time.monotonic() > end:
                raise TimeoutError("no localizer listens")
            rclpy.spin_once(self, timeout_sec=0.1)
        first, start = stamp_ns(self.messages[0][1]), time.time_ns() + 10**9
        for name, message in self.messages:
            due = stamp_ns(message) - first + start
            while time.time_ns() < due:
                rclpy.spin_once(self, timeout_sec=0.002)
            message.header.stamp = Time(sec=due // 10**9, nanosec=due % 10**9)
            self.out[name].publish(message)
        end = time.monotonic() + END
        while time.monotonic() < end:
            rclpy.spin_once(self, timeout_sec=0.1)


def main(out: Path) -> None:
    """Run the node and write the bag."""
    settings = data.path(data.WEBCAM) / "parameters.yaml"
    command = [str(Path(sys.executable).with_name("localizer"))]
    rclpy.init()
    with subprocess.Popen([*command, "--ros-args", "--params-file", str(settings)]) as node:
        run = Run()
        try:
            run.run()
        finally:
            node.terminate()
    with Writer(out) as bag:
        names = {
            name: bag.add_connection(f"/{NODE_NAME}/{name}", kind, typestore=NOETIC)
            for name, kind in KEPT.items()
        }
        for received, name, message in run.kept:
            made = NOETIC.serialize_ros1(as_ros1(message, KEPT[name]), KEPT[name])
            bag.write(names[name], received, made)
    print(f"{out}: {sum(name == topics.POSE for _, name, _ in run.kept)} poses")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
