# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/Imu of rosbags and of rclpy are read alike; what no IMU measures is refused."""

import importlib.util
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rs_localizer.io.bags import make_message
from rs_localizer.io.imu import read_imu
from rs_localizer.io.messages import MessageError

ROS = importlib.util.find_spec("rclpy") is not None


def make(**changed: Any) -> Any:
    fields = {
        "orientation_covariance": np.array([-1.0, *[0.0] * 8]),
        "angular_velocity": (0.1, -0.2, 0.3),
        "angular_velocity_covariance": np.zeros(9),
        "linear_acceleration": (0.5, 0.0, 9.8),
        "linear_acceleration_covariance": np.zeros(9),
        "frame": "imu_link",
    } | changed
    vectors = {}
    for name in ("angular_velocity", "linear_acceleration"):
        x, y, z = fields[name]
        vectors[name] = make_message("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
    stamp = make_message("builtin_interfaces/msg/Time", sec=12, nanosec=345_678_901)
    return make_message(
        "sensor_msgs/msg/Imu",
        header=make_message("std_msgs/msg/Header", stamp=stamp, frame_id=fields.pop("frame")),
        orientation=make_message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        **(fields | vectors),
    )


def as_rclpy(message: Any) -> Any:
    from rs_localizer.ros.node.conversion import copy_message

    return copy_message(message, message.__msgtype__)


MAKERS: list[Callable[[Any], Any]] = [lambda message: message, as_rclpy][: 1 + ROS]


@pytest.mark.parametrize("like", MAKERS)
def test_a_message(like):
    variances = np.diag([1e-4, 4e-4, 7e-4]).ravel()
    found = read_imu(like(make(angular_velocity_covariance=variances)))
    assert found.stamp_ns == 12_345_678_901
    assert found.frame == "imu_link"
    assert found.angular_velocity == (0.1, -0.2, 0.3)
    assert found.linear_acceleration == (0.5, 0.0, 9.8)


def test_a_gyroscope_alone():
    absent = np.array([-1.0, *[0.0] * 8])
    found = read_imu(make(linear_acceleration_covariance=absent))
    assert found.linear_acceleration is None
    assert read_imu(make(linear_acceleration=(0.0, math.inf, 0.0))).linear_acceleration is None
    assert read_imu(make(linear_acceleration=(0.0, 0.0, 0.0))).linear_acceleration is None
    # What an absent measurement holds does not matter.
    assert read_imu(
        make(linear_acceleration=(math.nan,) * 3, linear_acceleration_covariance=absent)
    ).angular_velocity == (0.1, -0.2, 0.3)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"angular_velocity_covariance": np.array([-1.0, *[0.0] * 8])}, "has no angular velocity"),
        ({"angular_velocity": (0.0, math.nan, 0.0)}, "angular_velocity is not finite: .*nan"),
        ({"angular_velocity": (0.0, 250.0, 0.0)}, r"\(0.0, 250.0, 0.0\) rad/s.*is it in rad/s"),
        ({"linear_acceleration": (0.0, 0.0, 9810.0)}, "9810.0.*is it in m/s"),
        ({"frame": ""}, "header.frame_id is empty"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_told(changed, said):
    with pytest.raises(MessageError, match=said):
        read_imu(make(**changed))
