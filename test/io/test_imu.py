# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/Imu of rosbags and of rclpy are read alike; what no IMU measures is refused."""

import math
from typing import Any

import numpy as np
import pytest

from rs_localizer.io.imu import make_reading, read_imu
from rs_localizer.io.messages import MessageError

ABSENT = np.array([-1.0, *[0.0] * 8])


def make(**changed: Any) -> Any:
    turn, push = changed.get("turn", (0.1, -0.2, 0.3)), changed.get("push", (0.5, 0.0, 9.8))
    frame = changed.get("frame", "imu_link")
    message = make_reading(12_345_678_901, np.array(turn), np.zeros(3), frame, (1e-4, 0.0))
    message.linear_acceleration.x, message.linear_acceleration.y, message.linear_acceleration.z = (
        push
    )
    message.angular_velocity_covariance = changed.get("turn_covariance", np.zeros(9))
    message.linear_acceleration_covariance = changed.get("push_covariance", np.zeros(9))
    return message


@pytest.mark.parametrize("of_rclpy", [False, True])
def test_a_message(of_rclpy):
    message = make()
    if of_rclpy:
        pytest.importorskip("rclpy")
        from rs_localizer.ros.node.conversion import copy_message

        message = copy_message(message, message.__msgtype__)
    found = read_imu(message)
    assert (found.stamp_ns, found.frame) == (12_345_678_901, "imu_link")
    assert found.angular_velocity == (0.1, -0.2, 0.3)
    assert found.linear_acceleration == (0.5, 0.0, 9.8)


@pytest.mark.parametrize(
    "changed",
    [
        {"push_covariance": ABSENT}, {"push": (0.0, math.inf, 0.0)}, {"push": (0.0, 0.0, 0.0)},
        {"push": (math.nan,) * 3, "push_covariance": ABSENT},
    ],
)  # fmt: skip
def test_a_gyroscope_alone(changed):
    found = read_imu(make(**changed))
    assert (found.angular_velocity, found.linear_acceleration) == ((0.1, -0.2, 0.3), None)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"turn_covariance": ABSENT}, "has no angular velocity"),
        ({"turn": (0.0, math.nan, 0.0)}, "angular_velocity is not finite: .*nan"),
        ({"turn": (0.0, 250.0, 0.0)}, r"\(0.0, 250.0, 0.0\) rad/s.*is it in rad/s"),
        ({"push": (0.0, 0.0, 9810.0)}, "9810.0.*is it in m/s"),
        ({"frame": ""}, "header.frame_id is empty"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_told(changed, said):
    with pytest.raises(MessageError, match=said):
        read_imu(make(**changed))
