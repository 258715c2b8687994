# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Two cameras at one node, in its own process: what it says is what replay says."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import robot as around
from opposed_pair import PARTS, hand, record, rich
from robot import ENVIRONMENT, replayed

from rs_localizer.io.bags import open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import TYPES
from rs_localizer.io.rigs import RIG_FRAME, optical_frame
from rs_localizer.io.transforms import Transform, make_transform
from rs_localizer.ros.node.conversion import copy_message, message_class


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """A pair, of which the second camera loses five images."""
    path = tmp_path_factory.mktemp("bags") / "pair"
    record(
        path, 0.7,
        keep=lambda image: image.name == "left" or not 1.2e9 < image.frame.stamp_ns < 1.37e9,
        max_orientation_deviation=1.0,
    )  # fmt: skip
    return path


class Robot(around.Robot):
    """Sends what two cameras see."""

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
                    0, RIG_FRAME, optical_frame(name), rig_from_camera,
                )
            )  # fmt: skip


def messages(recording: Path, robot: Robot) -> list[tuple[str, Any]]:
    """What the cameras send, in its order; their calibrations have been sent."""
    with open_bag(recording) as bag:
        sent = [
            (topic, copy_message(message, message.__msgtype__))
            for topic, _, message in bag.messages(tuple(robot.publishers))
        ]
    for name in PARTS.cameras:
        info = next(message for topic, message in sent if topic == f"/{name}/camera_info")
        robot.publishers[f"/{name}/camera_info"].publish(info)
    robot.peer.spin_until(lambda: False, 0.5)
    return [item for item in sent if item[0].endswith("/correspondences")]


def test_node_and_replay_say_the_same_of_a_pair(recording, tmp_path, start_node, peer):
    settings = recording / "parameters.yaml"
    offline = replayed(recording, tmp_path / "out", "--params", str(settings))
    node = start_node("--params-file", str(settings), **ENVIRONMENT)
    node.wait_for_log("active with solver")
    with around.tf2_ros() as tf2_ros:
        robot = Robot(peer, tf2_ros)
        robot.connect()
        peer.spin_until(lambda: False, 1.0)  # /tf_static comes, too
        for topic, message in messages(recording, robot):
            robot.publishers[topic].publish(message)
            peer.spin_until(lambda: False, 0.15)
        # The last frame may wait for an image that never comes.
        expected = len(offline["pose"]) - 1
        assert expected >= 18
        assert peer.spin_until(lambda: len(robot.answers["inliers"]) >= expected)
        for name in TYPES:
            answered = robot.answered(name)
            assert len(answered) >= expected
            assert answered.items() <= offline[name].items()
        assert peer.spin_until(lambda: "Inliers of right" in robot.values)
    assert "right is left out: no image in the last 3 frames" in node.log
    assert node.stop() == 0


def test_a_live_node_says_that_a_camera_stops_and_its_clock_jumps(tmp_path, start_node, peer):
    """And poses go on: one of each image of the other camera, but for those of the jump."""
    motion = hand(5.0, 3.5)
    start_ns = motion.intervals_ns[0][0]
    begin, again, jump = (start_ns + round(1e9 * seconds) for seconds in (1.0, 1.4, 2.0))
    record(
        tmp_path / "bag", motion=motion, points=rich(motion),
        keep=lambda image: image.name == "left" or not begin < image.frame.stamp_ns < again,
        stamp=lambda image: image.stamp_ns
        - (5_000_000_000 if image.name == "right" and image.frame.stamp_ns > jump else 0),
        **{"rig.estimate_time_offsets": True},
    )  # fmt: skip
    node = start_node("--params-file", str(tmp_path / "bag" / "parameters.yaml"), **ENVIRONMENT)
    node.wait_for_log("active with solver")
    said: list[str] = []
    with around.tf2_ros() as tf2_ros:
        robot = Robot(peer, tf2_ros)
        robot.connect()
        peer.spin_until(lambda: False, 1.0)  # /tf_static comes, too
        sent = messages(tmp_path / "bag", robot)
        for topic, message in sent:
            before = len(robot.answers["pose"])
            robot.publishers[topic].publish(message)
            # The second camera completes a frame.
            patience = 0.3 if topic.startswith("/right") else 0.06
            peer.spin_until(lambda before=before: len(robot.answers["pose"]) > before, patience)
            said.extend(text for name, text in robot.values.items() if name.startswith("Odd: "))
        peer.spin_until(lambda: False, 1.5)  # the diagnosis comes once a second
        said.extend(text for name, text in robot.values.items() if name.startswith("Odd: "))
        first = [stamp_ns(message) for topic, message in sent if topic.startswith("/left")]
        answered = sorted(robot.answered("pose"))
    assert any("right is left out: no image in the last" in text for text in said), said
    jumped = r"the clock of right jumped by about -(4\.9|5\.0)\d s: followed"
    assert any(re.search(jumped, text) for text in said), set(said)
    offset = float(robot.values["Clock offset of right (ms)"].split()[0])
    assert offset == pytest.approx(5000.0, abs=2.0)
    assert len(set(first) & set(answered)) >= 0.85 * len(first)
    assert max(np.diff([first[0], *answered, first[-1]])) < 0.35e9
    assert node.stop() == 0
