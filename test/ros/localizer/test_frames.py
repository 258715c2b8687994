# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""base_frame and publish_tf of the node in its own process, with tf2_ros or a stand-in for it."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import robot as around
from geometry_msgs.msg import TransformStamped
from rclpy.time import Time
from robot import ENVIRONMENT, INSTALLED, SHUTTER, START_NS, inputs, record, replayed

from rs_localizer.io.bags import make_message, open_bag, typestore
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import TYPES
from rs_localizer.ros.node.conversion import message_class

CAMERA = "camera_optical_frame"
# Numbers that survive any arithmetic: a camera at the front that looks to the left.
MOUNTING = ("base_link", CAMERA, (0.5, 0.25, 0.875), (-0.5, -0.5, 0.5, 0.5), 0)
ODOMETRY = [
    ("odom", "base_link", (0.1 * i, 0.3, 0.0), (0.0, 0.0, 0.6, 0.8), START_NS + i * 20_000_000)
    for i in range(12)
]
FRAMES = 5
Sample = tuple[str, str, tuple[float, ...], tuple[float, ...], int]


def stamped(make: Callable[..., Any], sample: Sample) -> Any:
    parent, child, (x, y, z), (qx, qy, qz, qw), stamp_ns = sample
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=make("std_msgs/msg/Header", stamp=stamp, frame_id=parent),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        ),
    )


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    more = [
        (topic, make_message("tf2_msgs/msg/TFMessage", transforms=[stamped(make_message, sample)]))
        for topic, sample in [("/tf_static", MOUNTING), *(("/tf", s) for s in ODOMETRY)]
    ]
    return record(tmp_path_factory.mktemp("bags") / "flight", count=FRAMES, more=more)


class Robot(around.Robot):
    """One with transforms."""

    def __init__(self, peer: Any, tf2_ros: Any) -> None:
        super().__init__(peer)
        self._tf2_ros = tf2_ros
        self._moving = tf2_ros.TransformBroadcaster(peer.node)
        self._static: list[Any] = []
        self.sent: list[TransformStamped] = []
        outer = self

        class Listener(tf2_ros.TransformListener):
            def callback(self, data: Any) -> None:
                super().callback(data)
                outer.sent += [t for t in data.transforms if t.header.frame_id == "map"]

        self.buffer = tf2_ros.Buffer()
        self.listener = Listener(self.buffer, peer.node)

    def transform(self, sample: Sample) -> None:
        item = stamped(lambda kind, **fields: message_class(kind)(**fields), sample)
        if sample[-1]:
            self._moving.sendTransform(item)
            return
        # tf2_ros of Jazzy sends the first transform of a child for ever.
        self._static.append(self._tf2_ros.StaticTransformBroadcaster(self.peer.node))
        self._static[-1].sendTransform(item)

    def connect(self) -> None:
        super().connect()
        # The listener of this class hears the transforms, too.
        assert self.peer.spin_until(lambda: self._moving.pub_tf.get_subscription_count() >= 2)

    def position(self) -> list[float]:
        """Of the last pose."""
        last = typestore().deserialize_cdr(self.answers["pose"][-1], TYPES["pose"])
        return [last.pose.position.x, last.pose.position.y, last.pose.position.z]


@pytest.fixture
def robot(peer) -> Iterator[Robot]:
    with around.tf2_ros() as tf2_ros:
        result = Robot(peer, tf2_ros)
        yield result
        result.listener.unregister()


def test_node_and_replay_say_the_same_of_the_base(recording, tmp_path, start_node, robot):
    settings = [*SHUTTER, "-p", "base_frame:=base_link", "-p", "publish_tf:=map_to_odom"]
    start_node(*settings, **ENVIRONMENT)
    robot.connect()
    for sample in (MOUNTING, *ODOMETRY):
        robot.transform(sample)
        robot.peer.spin_until(lambda: False, 0.01)
    for pair in inputs(recording):
        robot.localize(*pair)
    assert robot.peer.spin_until(lambda: len(robot.sent) >= FRAMES)
    offline = replayed(recording, tmp_path / "out", *settings)
    for name in TYPES:
        assert len(offline[name]) == FRAMES
        assert robot.answered(name) == offline[name]
    with open_bag(tmp_path / "out" / "result") as bag:
        corrections = [message.transforms[0] for _, _, message in bag.messages(["/tf"])]
    compare(corrections, {stamp_ns(item): item for item in robot.sent})
    # TF has a way from the map to the camera now, at the last time of odometry.
    robot.buffer.lookup_transform("map", CAMERA, Time())


def compare(corrections: list[Any], sent: dict[int, Any]) -> None:
    """The replay's corrections of odometry, and the node's by their stamps."""
    assert len(corrections) == len(sent) == FRAMES
    for correction in corrections:
        item = sent[stamp_ns(correction)]
        assert (item.header.frame_id, item.child_frame_id) == ("map", "odom")
        for part, names in (("translation", "xyz"), ("rotation", "xyzw")):
            numbers = [
                [getattr(getattr(of.transform, part), n) for n in names]
                for of in (item, correction)
            ]
            # The same bits with tf2_ros; the stand-in calculates in its own way.
            assert np.allclose(*numbers, rtol=0.0, atol=0.0 if INSTALLED else 1e-12)
