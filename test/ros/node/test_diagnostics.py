# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of a node, and the quality of service that it takes."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, PointCloud2

from rs_localizer.ros.node import subscriptions as inputs_module
from rs_localizer.ros.node.diagnostics import Diagnostics, Health, Level, State
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.statistics import missing
from rs_localizer.ros.node.subscriptions import LATCHED as LATCHED_DATA
from rs_localizer.ros.node.subscriptions import Inputs, Topic, best


class Bench:
    """Diagnostics without a graph, whose timer is turned by hand."""

    def __init__(self) -> None:
        self.health = Health(Level.OK, State.TRACKING, "all is well", {"State": "tracking"})
        self.lines: list[str] = []
        self.published: list[DiagnosticArray] = []
        node: Any = SimpleNamespace(
            get_fully_qualified_name=lambda: "/front/rs_localizer",
            create_publisher=lambda *_: SimpleNamespace(publish=self.published.append),
            create_timer=self._create_timer,
            get_clock=Clock,
        )
        self.clock: Any = None
        Diagnostics(
            node,
            lambda: (self.health, "camera"),
            lambda *texts: self.lines.append(": ".join(texts)),
            "localizer",
            "no_pose",
        )

    def _create_timer(self, period: float, callback: Any, clock: Any) -> None:
        assert period == 1.0
        self.tick, self.clock = callback, clock


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_the_message(bench):
    bench.tick()
    (status,) = bench.published[0].status
    assert status.name == "front/rs_localizer: localizer"
    assert (status.level, status.message, status.hardware_id) == (b"\0", "all is well", "camera")
    assert [(item.key, item.value) for item in status.values] == [("State", "tracking")]
    # ROS time may stand still.
    assert bench.clock.clock_type == ClockType.STEADY_TIME


@pytest.mark.parametrize(
    ("level", "state", "name"),
    [
        (Level.STALE, State.WAITING, "no_pose"),
        (Level.ERROR, "lost", "no_pose"),
        (Level.WARN, State.TRACKING, "tracking"),
    ],
)
def test_lines_of_a_lasting_state(bench, level, state, name):
    bench.health = Health(level, state, "something is wrong", {})
    when = []
    for second in range(1, 2000):
        before = len(bench.lines)
        bench.tick()
        if len(bench.lines) > before:
            when.append(second)
    assert when == [5, 10, 20, 40, 80, 160, 320, 640, 1280, 1920]
    assert set(bench.lines) == {f"{name}: something is wrong"}


@pytest.mark.parametrize(
    ("rate", "jitter", "share", "seeds"),
    [
        *((*each, 0.02, share, 1) for *each, share in
          ((10.0, 0.6), (10.0, 0.9), (30.0, 0.3), (30.0, 0.9), (60.0, 0.2))),
        # A steady camera misses nothing.
        *((rate, jitter, 1.0, 20) for rate in (10.0, 30.0, 60.0) for jitter in (0.0, 0.02, 0.05)),
    ],
)  # fmt: skip
def test_what_was_dropped_is_counted(rate, jitter, share, seeds):
    """Jitter as a part of the period."""
    for seed in range(seeds):
        rng, count = np.random.default_rng(seed), round(5 * rate)
        sent = (np.arange(count) + rng.normal(0.0, jitter, count)) * 1e9 / rate
        keep = rng.random(count) < share
        keep[[0, -1]] = True
        assert missing(sent[keep].astype(np.int64)) == count - keep.sum()


def test_a_clock_that_is_set_loses_nothing():
    sent = np.arange(30) * 33_333_333
    sent[15:] += 3_600_000_000_000
    assert missing(sent) == 0


def test_a_reason_is_logged_once_in_five_seconds_and_always_counted():
    lines, now = [], [100.0]
    refusals = Refusals(lines.append, clock=lambda: now[0])
    for second in range(12):
        now[0] = 100.0 + second
        refusals.add("odd", f"field {second}")
        refusals.notice("other", "no refusal")
    more = " (4 more since the last report)"
    assert [line for line in lines if "odd" in line] == [
        "odd: field 0", f"odd: field 5{more}", f"odd: field 10{more}"
    ]  # fmt: skip
    assert refusals.counts == {"odd": 12}
    assert refusals.recent({"odd", "other", "never"}, 1.0) == {
        "odd": "field 11", "other": "no refusal"
    }  # fmt: skip


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
