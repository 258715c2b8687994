# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A topic is heard as well as its publishers send it, whoever comes first."""

from collections.abc import Iterator
from typing import Any

import pytest
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, PointCloud2

from rs_localizer.ros.node import subscriptions as inputs_module
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.subscriptions import LATCHED as LATCHED_DATA
from rs_localizer.ros.node.subscriptions import Inputs, Topic, best

BEST_EFFORT, RELIABLE = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
VOLATILE, LATCHED = DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL
ANY = (ReliabilityPolicy.BEST_AVAILABLE, DurabilityPolicy.BEST_AVAILABLE)
WHOLE = QoSProfile(depth=1, reliability=RELIABLE, durability=LATCHED)


@pytest.fixture
def driver() -> Iterator[Node]:
    """A node of another process."""
    context = Context()
    context.init(args=[])
    node = Node("driver", context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


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


def test_a_topic_follows_its_publishers(peer):
    node, told = peer.node, Refusals(lambda text: None)
    # Once, before anybody listens.
    node.create_publisher(CameraInfo, "/camera_info", WHOLE).publish(CameraInfo(width=640))
    heard: dict[str, list[Any]] = {"camera_info": [], "correspondences": []}
    topics = {
        "camera_info": Topic(CameraInfo, heard["camera_info"].append, LATCHED_DATA),
        "correspondences": Topic(PointCloud2, heard["correspondences"].append),
    }
    inputs = Inputs(node, topics, told)

    def present() -> set[ReliabilityPolicy]:
        found = node.get_subscriptions_info_by_topic("/correspondences")
        return {info.qos_profile.reliability for info in found}

    assert peer.spin_until(lambda: present() == {BEST_EFFORT})
    assert peer.spin_until(lambda: heard["camera_info"])
    sender = node.create_publisher(PointCloud2, "/correspondences", 10)
    assert peer.spin_until(lambda: present() == {RELIABLE})
    other = node.create_publisher(
        PointCloud2, "/correspondences", QoSProfile(depth=1, reliability=BEST_EFFORT)
    )
    assert peer.spin_until(lambda: present() == {BEST_EFFORT})
    assert peer.spin_until(lambda: sender.publish(PointCloud2()) or heard["correspondences"])
    node.destroy_publisher(sender)
    node.destroy_publisher(other)
    peer.spin_until(lambda: False, 0.7)  # it looks twice a second
    assert present() == {BEST_EFFORT}  # nobody there: as it was
    inputs.close()
    assert not told.counts


def test_publishers_that_cannot_be_heard_are_named(peer, driver, monkeypatch):
    monkeypatch.setattr(inputs_module, "_LONG", 0.0)
    said: list[str] = []
    qos = {"depth": 1, "reliability": RELIABLE}
    topics = {name: Topic(PointCloud2, print, qos) for name in ("one", "other", "third")}
    inputs = Inputs(peer.node, topics, Refusals(said.append))
    driver.create_publisher(PointCloud2, "one", QoSProfile(depth=1, reliability=BEST_EFFORT))
    driver.create_publisher(CameraInfo, "other", 1)
    wanted = {
        "one": "the QoS of /driver does not fit: Best effort publisher and reliable subscription",
        "other": "/driver publishes sensor_msgs/msg/CameraInfo, not sensor_msgs/msg/PointCloud2",
        "third": "it has no publisher",
    }

    def causes() -> bool:
        return all(item.cause.startswith(wanted[name]) for name, item in inputs.silence().items())

    assert peer.spin_until(causes), inputs.silence()
    mismatches = {name: item.mismatch for name, item in inputs.silence().items()}
    assert mismatches == {"one": True, "other": True, "third": False}
    # Each topic by itself; who it is may not be known yet when it is said first.
    lines = [f"incompatible_publisher: no message arrives on /{name}: " for name in wanted]
    assert [any(text.startswith(line) for text in said) for line in lines] == [True, True, False]
    inputs.close()


def test_two_publishers_of_frames_are_named(peer, driver):
    said: list[str] = []
    topics = {"frames": Topic(PointCloud2, print, single=True), "info": Topic(CameraInfo, print)}
    for name, topic in topics.items():
        peer.node.create_publisher(topic.type, name, 1)
        driver.create_publisher(topic.type, name, 1)

    def known() -> set[str]:  # names of nodes come later than their publishers
        found = peer.node.get_publishers_info_by_topic("/frames")
        return {info.node_name for info in found}

    assert peer.spin_until(lambda: known() == {"driver", peer.node.get_name()})
    inputs = Inputs(peer.node, topics, Refusals(said.append))
    assert peer.spin_until(lambda: said)
    names = " and ".join(sorted(("/driver", f"/{peer.node.get_name()}")))
    assert said == [f"two_publishers: {names} publish on /frames: their frames alternate"]
    inputs.close()
