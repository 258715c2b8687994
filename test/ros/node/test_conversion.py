# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages of recordings become messages of rclpy and stay the same to the last byte."""

import array
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__CameraInfo as CameraInfo

from rs_localizer.io import bags
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.messages import make_header
from rs_localizer.ros.node.conversion import copy_message, make_message


def cloud(make: Any) -> Any:
    rows = np.zeros(3, [("x", "<f4"), ("id", "<u2")])
    rows["x"], rows["id"] = [1.5, -2.5, 1e30], [1, 2, 65535]
    return make_cloud(make, 1_700_000_000_000_000_001, "map", rows)


def info(make: Any) -> CameraInfo:
    return make(
        "sensor_msgs/msg/CameraInfo",
        header=make_header(make, 5, "camera"),
        height=480,
        width=640,
        distortion_model="plumb_bob",
        d=np.array([0.1, 0.2]),
        k=np.arange(9.0),
        r=np.arange(9.0),
        p=np.arange(12.0),
        binning_x=1,
        binning_y=2,
        roi=make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=1,
            y_offset=2,
            height=3,
            width=4,
            do_rectify=True,
        ),
    )


@pytest.mark.parametrize("build", [cloud, info])
def test_the_same_bytes_made_or_copied(build):
    recorded = build(bags.make_message)
    kind = recorded.__msgtype__
    expected = bytes(bags.typestore().serialize_cdr(recorded, kind))
    for message in (build(make_message), copy_message(recorded, kind)):
        again = bags.typestore().deserialize_cdr(serialize_message(message), kind)
        assert bytes(bags.typestore().serialize_cdr(again, kind)) == expected


def test_bytes_are_handed_over_as_rclpy_wants_them():
    assert isinstance(cloud(make_message).data, array.array)
