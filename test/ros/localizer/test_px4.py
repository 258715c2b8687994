# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The output for PX4: asked for, refused where it cannot be, and in px4_msgs' types."""

import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rs_localizer.config import NodeConfig
from rs_localizer.io.outputs import Localized, Pose
from rs_localizer.ros.localizer.node import Px4Output
from rs_localizer.ros.localizer.node import check_px4 as check
from rs_localizer.ros.node.conversion import message_class

STAND_IN = Path(__file__).parents[1] / "stand_in"
WANTED = NodeConfig(px4_odometry="ned", base_frame="base_link")


@pytest.fixture
def px4_msgs(monkeypatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(STAND_IN))
    yield
    message_class.cache_clear()
    for name in [name for name in sys.modules if name.split(".")[0] == "px4_msgs"]:
        del sys.modules[name]


class Publisher:
    def __init__(self, message_type: Any, topic: str) -> None:
        self.type, self.topic = message_type, topic
        self.listeners = 1
        self.sent: list[Any] = []
        self.publish = self.sent.append

    def get_subscription_count(self) -> int:
        return self.listeners


class Node:
    """As far as an output needs one: the stand-in has no type support for a real one."""

    def create_lifecycle_publisher(self, message_type: Any, topic: str, *_: Any, **__: Any) -> Any:
        self.publisher = Publisher(message_type, topic)
        return self.publisher

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=7_000_000_000))


def frame(seconds: float, x: float = 0.0) -> Localized:
    estimate: Any = SimpleNamespace(inliers=np.ones(20, dtype=bool))
    pose = Pose(np.array([x, 0.0, 0.0]), np.eye(3), 1e-4 * np.eye(6))
    stamp = round((5.0 + seconds) * 1e9)
    return Localized(stamp, stamp, "map", "base_link", pose, None, np.zeros(0), 0, estimate)


@pytest.mark.usefixtures("px4_msgs")
def test_frames_go_out_in_px4s_types():
    node: Any = Node()
    frames: Any = SimpleNamespace(config=WANTED)
    output = Px4Output(node, frames)
    assert node.publisher.topic == "~/vehicle_odometry"
    node.publisher.listeners = 0
    output.publish(frame(0.0))
    assert node.publisher.sent == []
    node.publisher.listeners = 1
    output.publish(frame(1 / 30, x=3.0))  # a jump, told by the frame nobody heard
    output.publish(frame(2 / 30, x=3.0))
    first, second = node.publisher.sent
    assert type(first).__name__ == "VehicleOdometry"
    assert (first.timestamp, first.timestamp_sample) == (7_000_000, 5_033_333)
    assert (first.reset_counter, second.reset_counter) == (1, 1)
    np.testing.assert_allclose(first.position, [0.0, 3.0, 0.0], atol=1e-6)


def test_without_px4_msgs_only_what_needs_it_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "px4_msgs", None)
    message_class.cache_clear()
    check(NodeConfig())
    with pytest.raises(ValueError, match="px4_odometry ned needs the package px4_msgs"):
        check(WANTED)
