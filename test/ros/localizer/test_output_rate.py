# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses at a rate of their own, predicted to now."""

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


def test_odometry_between_and_after_images(tmp_path, start_node, peer):
    """By a simulated clock, 25 ms after each image; then the images stop."""
    record(tmp_path / "flight")
    offline = CameraFrames(NodeConfig(readout_time=READOUT_TIME))
    start_node(*SHUTTER, "-p", "output_rate:=50.0", "-p", "use_sim_time:=true")
    robot = Robot(peer)
    clock = peer.node.create_publisher(Clock, "/clock", 10)
    robot.connect()

    def said() -> dict[int, object]:
        kind = TYPES["odometry"]
        found = [typestore().deserialize_cdr(d, kind) for d in robot.answers["odometry"]]
        assert [stamp_ns(one) for one in found] == sorted({stamp_ns(one) for one in found})
        return {stamp_ns(one): one for one in found}

    def turn_to(time_ns: int) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(time_ns, 10**9)
        clock.publish(message)

    for info, cloud in inputs(tmp_path / "flight"):
        robot.localize(info, cloud)
        offline.calibrate(read_camera_info(info))
        assert offline.localize(cloud)
        now_ns = stamp_ns(cloud) + 25_000_000
        expected = offline.at(now_ns)
        if expected is None:  # one frame alone is no motion yet
            continue
        turn_to(now_ns)
        assert peer.spin_until(lambda now_ns=now_ns: now_ns in said())
        place = said()[now_ns].pose.pose.position
        np.testing.assert_allclose([place.x, place.y, place.z], expected.pose.position, atol=1e-9)
    count = len(said())
    assert count >= 10
    turn_to(now_ns + 300_000_000)  # beyond max_prediction
    assert not peer.spin_until(lambda: len(said()) > count, 0.5)


def test_odometry_while_a_frame_is_localized(tmp_path, start_node, peer):
    """By a simulated clock; the fifth frame takes for ever."""
    slow = (
        "import time; from rs_localizer.pipeline.camera_frames import CameraFrames as F\n"
        "localize, count = F.localize, iter(range(1000))\n"
        "def wait(self, message):\n"
        "    if next(count) == 4: print('a slow frame', flush=True); time.sleep(9999)\n"
        "    return localize(self, message)\n"
        "F.localize = wait\n"
    )
    record(tmp_path / "flight")
    words = (*SHUTTER, "-p", "output_rate:=50.0", "-p", "use_sim_time:=true")
    node = start_node(*words, run=slow + RUN)
    robot = Robot(peer)
    clock = peer.node.create_publisher(Clock, "/clock", 10)
    robot.connect()
    flight = inputs(tmp_path / "flight")
    for info, cloud in flight[:4]:
        robot.localize(info, cloud)
    while "a slow frame" not in node.log:
        robot.send(*flight[4])
        peer.spin_until(lambda: False, 0.2)
    for later in (10, 20, 30):
        before, message = len(robot.answers["odometry"]), Clock()
        now_ns = stamp_ns(flight[3][1]) + later * 1_000_000
        message.clock.sec, message.clock.nanosec = divmod(now_ns, 10**9)
        clock.publish(message)
        assert peer.spin_until(lambda before=before: len(robot.answers["odometry"]) > before)
    assert len(robot.answers["inliers"]) == 4
