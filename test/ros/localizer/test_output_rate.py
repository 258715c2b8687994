# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses at a rate of their own, predicted to now."""

from typing import Any

import numpy as np
from rosgraph_msgs.msg import Clock

from rs_localizer.config import NodeConfig
from rs_localizer.io.bags import typestore
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import TYPES
from rs_localizer.pipeline.camera_frames import CameraFrames

from ..conftest import RUN  # noqa: TID252 - Python has a package "test"
from .robot import READOUT_TIME, SHUTTER, Robot, inputs, record

# The frame after the flight takes for ever.
SLOW = """
import time; from rs_localizer.pipeline.camera_frames import CameraFrames as F
localize, count = F.localize, iter(range(1000))
def wait(self, message):
    if next(count) == {frames}: print('a slow frame', flush=True); time.sleep(9999)
    return localize(self, message)
F.localize = wait
"""


def test_odometry_between_and_after_images(tmp_path, start_node, peer):
    """By a simulated clock: 25 ms after each image, while one is localized, and then no more."""
    record(tmp_path / "flight")
    flight = inputs(tmp_path / "flight")
    offline = CameraFrames(NodeConfig(readout_time=READOUT_TIME))
    words = (*SHUTTER, "-p", "output_rate:=50.0", "-p", "use_sim_time:=true")
    node = start_node(*words, run=SLOW.format(frames=len(flight)) + RUN)
    robot = Robot(peer)
    clock = peer.node.create_publisher(Clock, "/clock", 10)
    robot.connect()

    def said() -> dict[int, Any]:
        kind = TYPES["odometry"]
        found = [typestore().deserialize_cdr(d, kind) for d in robot.answers["odometry"]]
        assert [stamp_ns(one) for one in found] == sorted({stamp_ns(one) for one in found})
        return {stamp_ns(one): one for one in found}

    def turn_to(time_ns: int) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(time_ns, 10**9)
        clock.publish(message)

    def compare(time_ns: int) -> bool:
        expected = offline.at(time_ns)
        if expected is None:  # one frame alone is no motion yet
            return False
        turn_to(time_ns)
        assert peer.spin_until(lambda: time_ns in said())
        place = said()[time_ns].pose.pose.position
        np.testing.assert_allclose([place.x, place.y, place.z], expected.pose.position, atol=1e-9)
        return True

    compared = []
    for info, cloud in flight:
        robot.localize(info, cloud)
        offline.calibrate(read_camera_info(info))
        assert offline.localize(cloud)
        compared.append(compare(stamp_ns(cloud) + 25_000_000))
    assert sum(compared) >= 10
    cloud.header.stamp.nanosec += 10_000_000
    while "a slow frame" not in node.log:
        robot.send(None, cloud)
        peer.spin_until(lambda: False, 0.2)
    last_ns, count = stamp_ns(cloud), len(said())
    assert all(compare(last_ns + later * 1_000_000) for later in (30, 50, 70))
    assert len(robot.answers["inliers"]) == len(flight)
    turn_to(last_ns + 300_000_000)  # beyond max_prediction
    assert not peer.spin_until(lambda: len(said()) > count + 3, 0.5)
