# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Keypoints and maps over live DDS: latched, late, replaced, bad; said in the diagnostics."""

import os
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, PointCloud2

from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.maps.files import write_map_file
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import stamp_ns
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.ros.node.conversion import copy_message, make_message
from rs_localizer.simulation.frames import SimulatedFrame, simulate_frames
from rs_localizer.simulation.recording import write_simulated
from rs_localizer.simulation.scene import keypoint_rows, random_descriptors, room
from rs_localizer.simulation.settings import FrameSettings
from rs_localizer.simulation.true_motion import ConstantVelocity

READOUT_TIME = 0.03
K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
POINTS = room(np.zeros((1, 3)), np.random.default_rng(0), count=8000)
LANDMARKS = Map(POINTS, np.arange(8000), random_descriptors(8000, np.random.default_rng(2)), "map")


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> tuple[Any, list[SimulatedFrame]]:
    """The camera's message and frames with their truth."""
    camera = Camera(640, 480, K, readout_time=READOUT_TIME)
    motion = ConstantVelocity(
        np.array([0.5, -1.0, 1.0]), np.array([0.5, 0.5, -0.5]), 1.0, start_ns=10**9
    )
    seen = FrameSettings(points=80, noise=0.5, outliers=0.3)
    frames = list(simulate_frames(camera, motion, POINTS, seen))
    path = tmp_path_factory.mktemp("bags") / "flight"
    with BagWriter(path) as bag:
        write_simulated(bag, camera, frames[0])
    with open_bag(path) as bag:
        _, _, info = next(iter(bag.messages(("/camera_info",))))
    return copy_message(info, "sensor_msgs/msg/CameraInfo"), frames


class Talk:
    """Publishes a camera, maps and keypoints, and hears poses and diagnostics."""

    def __init__(self, peer: Any, info: Any) -> None:
        self.peer, self.info = peer, info
        node = peer.node
        self._infos = node.create_publisher(CameraInfo, "camera_info", 1)
        self._maps = node.create_publisher(PointCloud2, "map_points", LATCHED)
        self._keypoints = node.create_publisher(PointCloud2, "keypoints", qos_profile_sensor_data)
        self.poses: dict[int, Any] = {}
        self.status: dict[str, str] = {}
        self._subscriptions = [
            node.create_subscription(
                PoseStamped, "/rs_localizer/pose", lambda m: self.poses.update({stamp_ns(m): m}), 10
            ),
            node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 10),
        ]

    def _hear(self, message: Any) -> None:
        for status in message.status:
            if "rs_localizer" in status.name:
                self.status = {item.key: item.value for item in status.values}
                self.status["message"] = status.message

    def connect(self) -> None:
        publishers = (self._infos, self._maps, self._keypoints)
        assert self.peer.spin_until(
            lambda: (
                all(p.get_subscription_count() for p in publishers)
                and self.peer.node.count_publishers("/rs_localizer/pose")
            )
        )
        self.peer.spin_until(lambda: False, 0.2)  # the other side has to find us, too

    def keypoints(self, frame: SimulatedFrame, landmarks: Map = LANDMARKS) -> Any:
        rows = keypoint_rows(frame, landmarks, np.random.default_rng(frame.stamp_ns))
        return make_cloud(make_message, frame.stamp_ns, "camera", rows)

    def send(self, message: Any, timeout: float = 1.0) -> bool:
        """Send a camera and keypoints: whether a pose with their stamp came."""
        self._infos.publish(self.info)
        self.peer.spin_until(lambda: False, 0.02)
        self._keypoints.publish(message)
        return bool(self.peer.spin_until(lambda: stamp_ns(message) in self.poses, timeout))

    def localize(self, frame: SimulatedFrame, landmarks: Map = LANDMARKS) -> Any:
        """Send a frame until it is answered: the pose, which is compared with the truth."""
        message = self.keypoints(frame, landmarks)
        assert any(self.send(message) for _ in range(20)), f"no answer; {self.status}"
        pose = self.poses.pop(frame.stamp_ns)
        found = [getattr(pose.pose.position, name) for name in "xyz"]
        assert np.allclose(found, frame.first_row.positions[0], atol=0.02)
        return pose


def test_a_map_file(tmp_path, start_node, peer, flight):
    info, frames = flight
    path = tmp_path / "map.npz"
    write_map_file(path, LANDMARKS)
    given = ("-p", f"map_file:={path}", "-p", "map_frame:=hall")
    node = start_node("-p", f"readout_time:={READOUT_TIME}", *given)
    talk = Talk(peer, info)
    talk.connect()
    # What replay says of the same messages.
    replay = FrameLocalizer(
        NodeConfig(readout_time=READOUT_TIME, map_file=str(path), map_frame="hall")
    )
    replay.load_map()
    replay.calibrate(read_camera_info(info))
    for frame in frames[:6]:
        found = talk.localize(frame)
        assert found.header.frame_id == "hall"
        expected = replay.localize_keypoints(talk.keypoints(frame))
        assert expected
        position = [getattr(found.pose.position, name) for name in "xyz"]
        # What other tests have compiled in this process may round differently than the node.
        np.testing.assert_allclose(position, expected.pose.position, rtol=0.0, atol=1e-12)
        assert expected.estimate.tracked == (frame is not frames[0])
    node.wait_for_log("the map has 8000 landmarks in frame 'hall'")
    assert node.stop() == 0
    os.truncate(path, 1000)
    broken = start_node(*given)
    assert broken.process.wait(60) == 1
    assert f"not configured: map_file: {path}: no readable NumPy archive" in broken.log
    assert "Traceback" not in broken.log
