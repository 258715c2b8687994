# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Of several topics of inertial measurements the gyroscope is found by what it measures."""

from pathlib import Path

import numpy as np
import pytest

from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.imu import make_reading
from rs_localizer.offline.recordings import read_imu_recording
from rs_localizer.offline.replay import imu_topics

GYRO, ACCEL = "/camera/gyro/sample", "/camera/accel/sample"
RATE, FORCE, NOTHING = np.array([0.1, 0.2, -0.3]), np.array([0.0, -9.8, 0.5]), np.zeros(3)


def recorded(path: Path, absent: bool, *more: str) -> Path:
    """A RealSense's topics: what one does not measure is zero, or its covariance says so."""
    with BagWriter(path) as bag:
        for k in range(200):
            stamp = 10**9 + 5_000_000 * k
            turning = k > 20  # it begins at rest
            for topic in (GYRO, *more):
                gyro = make_reading(stamp, RATE * turning, NOTHING, "imu")
                bag.write(topic, gyro, stamp)
            accel = make_reading(stamp, NOTHING, FORCE, "imu")
            if absent:
                accel.angular_velocity_covariance[0] = -1.0
            bag.write(ACCEL, accel, stamp)
    return path


@pytest.mark.parametrize("absent", [True, False])
def test_an_accelerometer_beside_it_is_no_choice(absent, tmp_path):
    with open_bag(recorded(tmp_path / "bag", absent)) as bag:
        assert imu_topics(bag) == [GYRO]
        readings = read_imu_recording(bag, None)  # of calibrate --imu
        np.testing.assert_array_equal(readings.angular_velocities[-1], RATE)


def test_two_gyroscopes_are_a_choice(tmp_path):
    with open_bag(recorded(tmp_path / "bag", False, "/other")) as bag:
        assert imu_topics(bag) == [GYRO, "/other"]
