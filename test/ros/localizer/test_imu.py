# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""An IMU beside the camera, heard by a node in its own process: as offline, or as without it."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import robot as around
from robot import ENVIRONMENT, KINDS, SHUTTER, replayed

from rs_localizer.cli.main import main as command_line
from rs_localizer.io.bags import open_bag
from rs_localizer.io.outputs import TYPES
from rs_localizer.ros.node.conversion import copy_message

# The node's inputs are best effort, and a busy machine loses messages: here, none may be lost.
RELIABLE = [
    word
    for topic in ("/imu", "/camera_info", "/correspondences")
    for word in ("-p", f"qos_overrides.{topic}.subscription.reliability:=reliable")
]
FRAMES = 30
Item = tuple[str, int, Any]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "flight"
    words = ("--trajectory", "tum_vi_room5", "--start", "20", "--duration", "1")
    seen = ("--points", "60", "--noise", "0.3", "--outliers", "0.1")
    assert command_line(["simulate", str(path), *words, *seen, "--imu"]) == 0
    return path


@pytest.fixture(scope="module")
def alone(recording, tmp_path_factory) -> dict[str, dict[int, bytes]]:
    """What replay says without the IMU."""
    return replayed(recording, tmp_path_factory.mktemp("alone") / "out", *SHUTTER, "--no-imu")


@pytest.fixture(scope="module")
def items(recording) -> list[Item]:
    with open_bag(recording) as bag:
        return [
            (topic, recorded_ns, copy_message(message, message.__msgtype__))
            for topic, recorded_ns, message in bag.messages(KINDS)
        ]


class Robot(around.Robot):
    """One with an IMU."""

    def __init__(self, peer: Any, tf2_ros: Any) -> None:
        super().__init__(peer, "/imu")
        self._sent = 0
        self._static = tf2_ros.StaticTransformBroadcaster(peer.node)

    def mount(self, recording: Path) -> None:
        with open_bag(recording) as bag:
            ((_, _, message),) = bag.messages(["/tf_static"])
        transform = message.transforms[0]
        self._static.sendTransform(copy_message(transform, "geometry_msgs/msg/TransformStamped"))

    def greet(self, items: list[Item]) -> None:
        """The camera, and the first reading, at which the node begins to listen to TF.

        Until it does: it may still have been looking for us.
        """
        for _ in range(20):
            for topic in ("/camera_info", "/imu"):
                self.pass_on(next(item for item in items if item[0] == topic))
            if self.peer.spin_until(self._is_heard, 1.0):
                break
        else:
            raise AssertionError("the node does not listen to TF")
        self.peer.spin_until(lambda: False, 1.0)

    def _is_heard(self) -> bool:
        return bool(self.peer.node.count_subscribers("/tf_static"))

    def pass_on(self, item: Item) -> None:
        self.publishers[item[0]].publish(item[2])
        self._sent += item[0] == "/correspondences"

    def wait_for_answers(self) -> None:
        """To all frames so far."""
        answered = self.answers["inliers"]
        assert self.peer.spin_until(lambda: len(answered) == self._sent, 20.0), (
            f"{len(answered)} of {self._sent} frames: {self.values}"
        )

    def play(self, items: list[Item]) -> None:
        """Send in this order, frames one by one: of those that wait the newest would win."""
        for item in items:
            if item[0] == "/correspondences":
                self.wait_for_answers()
            self.pass_on(item)
        self.wait_for_answers()


@pytest.fixture
def robot(peer) -> Iterator[Robot]:
    with around.tf2_ros() as tf2_ros:
        yield Robot(peer, tf2_ros)


def at_frames(items: list[Item], late: float) -> list[list[Item]]:
    """What comes until each frame, where readings come so many seconds late."""
    parts: list[list[Item]] = [[]]
    order = sorted(items, key=lambda item: item[1] * 1e-9 + late * (item[0] == "/imu"))
    for item in order:
        parts[-1].append(item)
        if item[0] == "/correspondences":
            parts.append([])
    return parts


def test_node_and_replay_say_the_same(recording, items, alone, tmp_path, start_node, robot):
    start_node(*SHUTTER, *RELIABLE, "-p", "imu.wait:=1.0", **ENVIRONMENT)
    robot.connect()
    robot.mount(recording)
    robot.greet(items)
    robot.play(items)
    assert robot.peer.spin_until(lambda: "IMU" in robot.values)
    used = (robot.values["IMU"], robot.values["IMU used (share of the last frames)"])
    assert used == ("used", "100%"), robot.values
    both = replayed(recording, tmp_path / "both", *SHUTTER)
    for name in TYPES:
        assert len(both[name]) == FRAMES
        assert robot.answered(name) == both[name]
    assert both["twist"] != alone["twist"]
    assert float(robot.values["IMU rate (Hz)"]) == pytest.approx(400.0)
    assert re.match(r"(-?\d+\.\d+ ){3}\+- ", robot.values["IMU bias (deg/s, camera axes)"])
    assert re.match(r"-?\d+\.\d+ \+- ", robot.values["IMU time offset (ms)"])


def test_an_imu_that_is_late_is_not_waited_for(recording, items, alone, start_node, robot):
    node = start_node(*SHUTTER, *RELIABLE, **ENVIRONMENT)
    robot.connect()
    robot.mount(recording)
    robot.greet(items)
    for part in at_frames(items, 0.1):
        robot.play(part)
    for name in TYPES:
        assert robot.answered(name) == alone[name]
    node.wait_for_log("imu_late: the IMU is not used: IMU messages arrive later than imu.wait")
    assert robot.peer.spin_until(lambda: "IMU not used: imu_late" in robot.values)
    assert "older than the last row" in robot.values["IMU"]
    assert "imu.wait" in robot.values["Odd: imu"]
