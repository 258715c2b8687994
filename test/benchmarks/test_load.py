# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The load benchmark counts what it sends; its figures are no matter of tests."""

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2

from benchmarks.load.frames import Frames, simulated
from benchmarks.load.measuring import steady


def test_frames_never_end_and_are_known_by_their_stamps(tmp_path):
    frames = simulated(points=30, outliers=0.3, rate=30.0, different=50)
    frames.save(tmp_path / "frames.npz")
    loaded = Frames.load(tmp_path / "frames.npz")
    assert (loaded.rate, loaded.camera_info) == (30.0, frames.camera_info)
    assert loaded.clouds == frames.clouds
    for index in (0, 1, 49, 50, 123_456):
        cloud = deserialize_message(loaded.cloud(index), PointCloud2)
        stamp = cloud.header.stamp
        assert abs(stamp.sec + 1e-9 * stamp.nanosec - (1000.0 + index / 30.0)) < 1e-6
        pose = PoseStamped()
        pose.header.stamp = stamp
        assert loaded.index(serialize_message(pose)) == index
        first = deserialize_message(bytes(loaded.clouds[index % 50]), PointCloud2)
        assert cloud.data == first.data
        assert cloud.width == 30


@pytest.mark.bench
def test_every_frame_is_accounted_for():
    frames = simulated(points=60, outliers=0.2, rate=20.0, different=40, imu_rate=200.0)
    (result,) = steady(frames, cameras=1, count=60)
    assert result.frames == 60
    # On a busy machine frames are replaced, and some sensor data may be lost.
    assert result.answered > 0
    assert result.lost <= 5
    assert len(result.latencies) == result.answered
    assert np.all((result.latencies > 0.0) & (result.latencies < 5.0))
    assert np.all(result.memory > 50.0)
    assert 0.0 < result.cpu < 2.0
    assert result.imu.endswith("%")
