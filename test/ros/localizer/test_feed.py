# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The latest camera_info is used, whatever the worker has got round to."""

from collections.abc import Callable
from typing import Any

import pytest
from sensor_msgs.msg import CameraInfo

from rs_localizer.config import NodeConfig
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.ros.localizer.node import Feed
from rs_localizer.ros.node.refusals import Refusals


class Bench:
    """A feed whose worker works on demand."""

    def __init__(self) -> None:
        self.updates: dict[str, Callable[[FrameLocalizer], None]] = {}
        self.frames = FrameLocalizer(NodeConfig())
        self.refusals = Refusals(lambda text: None)
        worker: Any = self
        self.feed = Feed(worker, self.frames, self.refusals, lambda text: None)

    def update(self, kind: str, update: Callable[[FrameLocalizer], None]) -> None:
        self.updates[kind] = update

    def work(self) -> int:
        """Carry out what waits; how much there was."""
        waiting, self.updates = self.updates, {}
        for update in waiting.values():
            update(self.frames)
        return len(waiting)

    def take(self, width: int, D: tuple[float, ...] = ()) -> None:
        message = CameraInfo(width=width, height=480, distortion_model="plumb_bob", d=list(D))
        message.header.frame_id = "camera"
        message.k = [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]
        self.feed.topics(NodeConfig())["camera_info"].callback(message)

    @property
    def width(self) -> int:
        assert self.frames.calibration is not None
        return self.frames.calibration.width


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_back_to_the_old_one_before_the_new_one_was_used(bench):
    bench.take(640)
    bench.work()
    bench.take(1280)
    bench.take(640)
    bench.work()
    assert bench.width == 640


def test_a_bad_one_neither_replaces_a_good_one_nor_is_forgotten(bench):
    bench.take(640)
    bench.take(0)
    bench.work()
    assert bench.width == 640
    # Only the worker finds that no lens is like this.
    for _ in range(3):
        bench.take(640, D=(0.1, 0.2, 0.3))
        assert bench.work() == 1
    assert bench.refusals.counts == {"bad_camera_info": 4}
    assert bench.width == 640
    bench.take(1280)
    bench.work()
    assert bench.width == 1280
