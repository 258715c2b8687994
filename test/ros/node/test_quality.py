# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A topic is heard as well as its publishers send it, whoever comes first."""

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from rs_localizer.ros.node.inputs import Inputs, best

BEST_EFFORT, RELIABLE = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
VOLATILE, LATCHED = DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL
ANY = (ReliabilityPolicy.BEST_AVAILABLE, DurabilityPolicy.BEST_AVAILABLE)
WHOLE = QoSProfile(depth=1, reliability=RELIABLE, durability=LATCHED)


@pytest.mark.parametrize(
    ("wished", "offers", "expected"),
    [
        (ANY, [], (BEST_EFFORT, VOLATILE)),
        (ANY, [(RELIABLE, LATCHED)], (RELIABLE, LATCHED)),
        (ANY, [(RELIABLE, VOLATILE)], (RELIABLE, VOLATILE)),
        (ANY, [(RELIABLE, LATCHED), (BEST_EFFORT, VOLATILE)], (BEST_EFFORT, VOLATILE)),
        ((RELIABLE, ANY[1]), [(BEST_EFFORT, LATCHED)], (RELIABLE, LATCHED)),
        ((BEST_EFFORT, VOLATILE), [(RELIABLE, LATCHED)], (BEST_EFFORT, VOLATILE)),
    ],
)
def test_the_best_that_all_offer(wished, offers, expected):
    assert best(wished, offers) == expected


@pytest.mark.parametrize(
    ("kind", "quality", "large"),
    [(Image, BEST_EFFORT, True), (Image, RELIABLE, False), (CameraInfo, BEST_EFFORT, False)],
)
def test_why_large_messages_are_lost_is_said(kind, quality, large):
    profile = QoSProfile(depth=1, reliability=quality)
    name = f"sensor_msgs/msg/{kind.__name__}"
    camera = SimpleNamespace(
        topic_type=name, node_namespace="/", node_name="camera", qos_profile=profile
    )
    node: Any = SimpleNamespace(
        _node=SimpleNamespace(get_publishers_info_by_topic=lambda topic: [camera])
    )
    topic: Any = SimpleNamespace(msg_type=kind, topic_name="/image", qos_profile=profile)
    cause, mismatch = Inputs._cause(node, topic)
    assert cause.startswith("it has 1 publisher, but no message comes")
    assert ("above half a megabyte are lost" in cause, mismatch) == (large, False)


def heard_with(peer: Any, topic: str) -> Callable[[], set[ReliabilityPolicy]]:
    return lambda: {
        info.qos_profile.reliability
        for info in peer.node.get_subscriptions_info_by_topic(topic)
        if info.node_name == "rs_localizer"
    }


def test_the_node_follows_its_publishers(start_node, peer):
    node = start_node()
    present = heard_with(peer, "/correspondences")
    assert peer.spin_until(lambda: present() == {BEST_EFFORT})
    sender = peer.node.create_publisher(PointCloud2, "/correspondences", 10)
    assert peer.spin_until(lambda: present() == {RELIABLE})
    other = peer.node.create_publisher(
        PointCloud2, "/correspondences", QoSProfile(depth=1, reliability=BEST_EFFORT)
    )
    assert peer.spin_until(lambda: present() == {BEST_EFFORT})
    peer.node.destroy_publisher(sender)
    peer.node.destroy_publisher(other)
    peer.spin_until(lambda: False, 1.5)
    assert present() == {BEST_EFFORT}  # nobody there: as it was
    assert "internal_error" not in node.log
    assert node.stop() == 0


def test_a_latched_camera_info_is_heard(start_node, peer):
    info = CameraInfo(width=640, height=480, distortion_model="plumb_bob", d=[0.0] * 5)
    info.k = [500.0, 0.0, 319.5, 0.0, 500.0, 239.5, 0.0, 0.0, 1.0]
    info.header.frame_id = "camera"
    publisher = peer.node.create_publisher(CameraInfo, "/camera_info", WHOLE)
    publisher.publish(info)  # once, before there is a node
    node = start_node()
    node.wait_for_log("active with solver")
    # A cloud is looked at only once there is a camera.
    cloud = peer.node.create_publisher(PointCloud2, "/correspondences", 10)
    deadline = time.monotonic() + 30.0
    message = PointCloud2(height=1, width=0)
    message.header.frame_id = "map"
    while "empty_cloud" not in node.log and "bad_cloud" not in node.log:
        assert time.monotonic() < deadline, node.log
        cloud.publish(message)
        peer.spin_until(lambda: False, 0.1)
    assert node.stop() == 0
