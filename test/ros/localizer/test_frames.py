# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""base_frame, publish_tf and an IMU, in a node of its own, with tf2_ros or a stand-in for it."""

import re
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recorded
from geometry_msgs.msg import TransformStamped
from rclpy.time import Time
from scipy.spatial.transform import Rotation, Slerp

from rs_localizer.io.bags import BagWriter, make_message, open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import TYPES
from rs_localizer.io.recording import CAMERA_FRAME
from rs_localizer.io.transforms import Transform, make_transform
from rs_localizer.ros.node.conversion import copy_message

from . import robot as around
from .robot import ENVIRONMENT, INSTALLED, KINDS, SHUTTER, replayed

FLIGHT = (
    "--trajectory", "tum_vi_room5", "--start", "20", "--duration", "0.6", "--points", "60",
    "--noise", "0.3", "--outliers", "0.1", "--imu",
)  # fmt: skip
# Numbers that survive any arithmetic: a camera at the front that looks to the left.
LEFT = Rotation.from_quat([-0.5, -0.5, 0.5, 0.5])
MOUNTING = Transform(LEFT.as_matrix(), np.array([0.5, 0.25, 0.875]))
# The node's inputs are best effort, and a busy machine loses messages: here, none may be lost. The
# readings before the first frame are more than the 200 that wait in a node, and are sent at once.
RELIABLE = [
    word
    for topic in KINDS
    for policy in ("reliability:=reliable", "depth:=1000")
    for word in ("-p", f"qos_overrides.{topic}.subscription.{policy}")
]


def true_odometry(truth: list[Any]) -> Iterator[tuple[int, Transform]]:
    """Odometry at 50 Hz, which rests before the flight and after it."""
    first_ns = stamp_ns(truth[0])
    times = np.array([1e-9 * (stamp_ns(message) - first_ns) for message in truth])
    places = [message.pose.position for message in truth]
    places = np.array([(place.x, place.y, place.z) for place in places])
    turns = [message.pose.orientation for message in truth]
    turns = Slerp(times, Rotation.from_quat([(q.x, q.y, q.z, q.w) for q in turns]))
    for tick in range(-3, round(50.0 * times[-1]) + 5):
        time = min(max(0.02 * tick, 0.0), times[-1])
        place = np.array([np.interp(time, times, row) for row in places.T])
        camera = Transform(turns(time).as_matrix(), place)
        yield first_ns + tick * 20_000_000, camera @ MOUNTING.inverse()


def record(folder: Path) -> Path:
    """A flight with an IMU, of a robot that knows where its camera is, and has odometry."""
    recorded.record(folder / "flight", *FLIGHT)
    with open_bag(folder / "flight") as bag:
        items = list(bag.messages((*KINDS, "/tf_static")))
        truth = [message for _, _, message in bag.messages(("/truth/pose",))]
    mounting = make_transform(make_message, 0, "base_link", CAMERA_FRAME, MOUNTING)
    odometry = [
        make_transform(make_message, stamp, "odom", "base_link", body)
        for stamp, body in true_odometry(truth)
    ]
    with BagWriter(folder / "robot") as bag:
        for item in (mounting, *odometry):
            message = make_message("tf2_msgs/msg/TFMessage", transforms=[item])
            bag.write("/tf_static" if item is mounting else "/tf", message, items[0][1])
        for topic, recorded_ns, message in items:
            bag.write(topic, message, recorded_ns)
    return folder / "robot"


class Robot(around.Robot):
    def __init__(self, peer: Any, tf2_ros: Any) -> None:
        super().__init__(peer, "/imu")
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

    def transform(self, recorded: Any) -> None:
        item = copy_message(recorded, "geometry_msgs/msg/TransformStamped")
        if stamp_ns(item):
            self._moving.sendTransform(item)
            return
        # tf2_ros of Jazzy sends the first transform of a child for ever.
        self._static.append(self._tf2_ros.StaticTransformBroadcaster(self.peer.node))
        self._static[-1].sendTransform(item)

    def connect(self) -> None:
        super().connect()
        # The listener of this class hears the transforms, too.
        assert self.peer.spin_until(lambda: self._moving.pub_tf.get_subscription_count() >= 2)

    def play(self, messages: list[tuple[str, Any]], odometry: list[Any]) -> int:
        """Send in this order, each frame when the last is answered; how many there were.

        Of frames that wait the newest would win, and one may wait for readings that follow it.
        Each is sent when odometry has come a little further than it, and no further: the node
        corrects the newest odometry, and sends nothing again for the same.
        """
        sent, answers, coming = 0, self.answers["inliers"], deque(odometry)
        for topic, message in [*messages, ("/correspondences", None)]:
            if topic == "/correspondences":
                # The first correction is sent for the frame's own time, too.
                for heard, count in ((answers, sent), (self.sent, sent and sent + 1)):
                    assert self.peer.spin_until(
                        lambda heard=heard, count=count: len(heard) >= count
                    ), self.values
                sent += 1
            if message is None:
                continue
            if topic == "/correspondences":
                newest = 0
                while newest <= stamp_ns(message):
                    newest = stamp_ns(coming[0])
                    self.transform(coming.popleft())
                self.peer.spin_until(lambda: False, 0.2)
            self.publishers[topic].publish(message)
        return sent - 1


def test_node_and_replay_say_the_same_of_the_base(tmp_path, start_node, peer):
    recording = record(tmp_path)
    with open_bag(recording) as bag:
        transforms = [
            item for _, _, m in bag.messages(("/tf_static", "/tf")) for item in m.transforms
        ]
        found = [(t, copy_message(m, m.__msgtype__)) for t, _, m in bag.messages(tuple(KINDS))]
    settings = [*SHUTTER, "-p", "base_frame:=base_link", "-p", "publish_tf:=map_to_odom"]
    start_node(*settings, *RELIABLE, "-p", "imu.wait:=1.0", "-p", "tf_rate:=0.0", **ENVIRONMENT)
    with around.tf2_ros() as tf2_ros:
        robot = Robot(peer, tf2_ros)
        robot.connect()
        for item in transforms:
            if not stamp_ns(item):
                robot.transform(item)
        peer.spin_until(lambda: False, 1.0)
        frames = robot.play(found, [item for item in transforms if stamp_ns(item)])
        # TF has a way from the map to the camera now, at the last time of odometry.
        robot.buffer.lookup_transform("map", CAMERA_FRAME, Time())
        robot.listener.unregister()
    offline = replayed(recording, tmp_path / "out", *settings)
    for name in TYPES:
        # The first twist may be unknown.
        assert len(offline[name]) in ({frames - 1, frames} if name == "twist" else {frames})
        assert robot.answered(name) == offline[name]
    with open_bag(tmp_path / "out" / "result") as bag:
        corrections = [message.transforms[0] for _, _, message in bag.messages(["/tf"])]
    compare(corrections, robot.sent)
    assert peer.spin_until(lambda: "IMU" in robot.values)
    used = (robot.values["IMU"], robot.values["IMU used (share of the last frames)"])
    assert used == ("used", "100%"), robot.values
    assert float(robot.values["IMU rate (Hz)"]) == pytest.approx(400.0)
    assert re.match(r"(-?\d+\.\d+ ){3}\+- ", robot.values["IMU bias (deg/s, camera axes)"])
    assert re.match(r"-?\d+\.\d+ \+- ", robot.values["IMU time offset (ms)"])


def compare(corrections: list[Any], sent: list[Any]) -> None:
    """The replay's corrections of odometry, and the node's, which are those of newer odometry."""
    assert len(corrections) == len(sent) - 1 > 0
    assert sent[0].transform == sent[1].transform
    for correction, item in zip(corrections, sent[1:], strict=True):
        assert 0 <= stamp_ns(item) - stamp_ns(correction) <= 20_000_000
        assert (item.header.frame_id, item.child_frame_id) == ("map", "odom")
        for part, names in (("translation", "xyz"), ("rotation", "xyzw")):
            numbers = [
                [getattr(getattr(of.transform, part), n) for n in names]
                for of in (item, correction)
            ]
            # The same bits with tf2_ros; the stand-in calculates in its own way.
            assert np.allclose(*numbers, rtol=0.0, atol=0.0 if INSTALLED else 1e-12)
