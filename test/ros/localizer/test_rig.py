# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Two cameras at one node, in its own process: what it says is what replay says."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.srv import GetState
from rclpy.duration import Duration

from rs_localizer.io.bags import open_bag
from rs_localizer.io.outputs import TYPES
from rs_localizer.io.transforms import Transform, make_transform
from rs_localizer.ros.node.conversion import copy_message, make_message, message_class
from rs_localizer.tools.simulation.simulated_recording import RIG_FRAME

from ...pipeline.opposed_pair import PARTS, record  # noqa: TID252 - Python has a package "test"
from ..conftest import TIMEOUT  # noqa: TID252
from . import robot as around
from .robot import ENVIRONMENT, replayed

# Here, no image may be lost.
RELIABLE = [
    word
    for name in PARTS.cameras
    for topic in ("camera_info", "correspondences")
    for word in ("-p", f"qos_overrides./{name}/{topic}.subscription.reliability:=reliable")
]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """A pair, of which the second camera loses five images."""
    path = tmp_path_factory.mktemp("bags") / "pair"
    record(
        path, 0.7,
        keep=lambda image: image.name == "left" or not 1.2e9 < image.frame.stamp_ns < 1.37e9,
    )  # fmt: skip
    return path


class Robot(around.Robot):
    def __init__(self, peer: Any, tf2_ros: Any) -> None:
        super().__init__(peer)
        self.publishers = {
            f"/{name}/{topic}": peer.node.create_publisher(kind, f"/{name}/{topic}", 100)
            for name in PARTS.cameras
            for topic, kind in (
                ("camera_info", around.CameraInfo), ("correspondences", around.PointCloud2),
            )
        }  # fmt: skip
        self._static = []
        for name, mount in PARTS.camera_from_rig.items():
            self._static.append(tf2_ros.StaticTransformBroadcaster(peer.node))
            rig_from_camera = Transform(*mount).inverse()
            self._static[-1].sendTransform(
                make_transform(
                    lambda kind, **fields: message_class(kind)(**fields),
                    0, RIG_FRAME, f"{name}_optical_frame", rig_from_camera,
                )
            )  # fmt: skip


def messages(recording: Path, robot: Robot) -> list[tuple[str, int, Any]]:
    """What the cameras send, and when, in its order; their calibrations have been sent."""
    with open_bag(recording) as bag:
        sent = [
            (topic, time_ns, copy_message(message, message.__msgtype__))
            for topic, time_ns, message in bag.messages(tuple(robot.publishers))
        ]
    for name in PARTS.cameras:
        info = next(message for topic, _, message in sent if topic == f"/{name}/camera_info")
        robot.publishers[f"/{name}/camera_info"].publish(info)
    robot.peer.spin_until(lambda: False, 0.5)
    return [item for item in sent if item[0].endswith("/correspondences")]


def play(recording: Path, out: Path, robot: Robot, expected: int) -> None:
    """Send all images, each when the node has taken the one before, as it takes what is recorded.

    An image has been taken when a frame is answered that replay wrote at its time. Others wait for
    another camera's image.
    """
    with open_bag(out / "result") as bag:
        due = [time_ns for _, time_ns, _ in bag.messages(["/rs_localizer/inliers"])]
    waiting, before, peer = "", 0, robot.peer
    for count, (topic, time_ns, message) in enumerate(messages(recording, robot)):
        if topic == waiting:
            # Of two images of one camera the newer would win: a node at rest has taken the first.
            said = len(robot.states)
            assert peer.spin_until(
                lambda said=said, count=count: (
                    robot.received == count and len(robot.states) > said + 1
                )
            )
        robot.publishers[topic].publish(message)
        now = min(expected, sum(time <= time_ns for time in due))
        assert peer.spin_until(lambda now=now: len(robot.answers["inliers"]) >= now)
        waiting = ""
        if now == before:
            waiting = topic
            # What has arrived is taken before a service is answered, and so before the next image.
            assert robot.publishers[topic].wait_for_all_acked(Duration(seconds=TIMEOUT))
            peer.call(GetState, "/rs_localizer/get_state", GetState.Request())
        before = now


def test_node_and_replay_say_the_same_of_a_pair(recording, tmp_path, start_node, peer):
    settings = recording / "parameters.yaml"
    offline = replayed(recording, tmp_path / "out", "--params", str(settings))
    node = start_node("--params-file", str(settings), *RELIABLE, **ENVIRONMENT)
    node.wait_for_log("active with solver")
    with around.tf2_ros() as tf2_ros:
        robot = Robot(peer, tf2_ros)
        robot.connect()
        peer.spin_until(lambda: False, 1.0)  # /tf_static comes, too
        # The last frame may wait for an image that never comes.
        expected = len(offline["pose"]) - 1
        assert expected >= 18
        play(recording, tmp_path / "out", robot, expected)
        for name in TYPES:
            answered = robot.answered(name)
            assert len(answered) >= len(offline[name]) - 1
            assert answered.items() <= offline[name].items()
        assert peer.spin_until(lambda: "Inliers of right" in robot.values)
        assert "Notice: no_images" in robot.odd
    assert "right is left out: no image in the last 3 frames" in node.log
    assert node.stop() == 0


def test_a_click_begins_the_transform_of_a_pair(recording, start_node, peer):
    node = start_node(
        "--params-file", str(recording / "parameters.yaml"), "-p", "publish_tf:=map_to_odom",
        "-p", f"base_frame:={RIG_FRAME}", **ENVIRONMENT,
    )  # fmt: skip
    node.wait_for_log("active with solver")
    with around.tf2_ros() as tf2_ros:
        odometry = tf2_ros.StaticTransformBroadcaster(peer.node)
        at = Transform(np.eye(3), np.zeros(3))
        odometry.sendTransform(make_transform(make_message, 0, "odom", RIG_FRAME, at))
        click = PoseWithCovarianceStamped()
        click.header.frame_id, click.pose.pose.orientation.w = "map", 1.0
        sender = peer.node.create_publisher(PoseWithCovarianceStamped, "/initialpose", 1)
        assert peer.spin_until(sender.get_subscription_count, 20.0)
        peer.spin_until(lambda: False, 1.0)  # /tf_static comes, too
        sender.publish(click)
        assert peer.spin_until(lambda: "pose_given: taken: map -> odom begins" in node.log)
    assert node.stop() == 0
