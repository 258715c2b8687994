# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The six messages of a frame: values, frames and stamps, and what is left out without a twist."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from rs_localizer.core import so3
from rs_localizer.core.types import Estimate
from rs_localizer.io.bags import make_message, typestore
from rs_localizer.io.outputs import TYPES, Localized, Pose, Twist, messages


@pytest.fixture
def frame() -> Localized:
    rng = np.random.default_rng(1)
    rows = np.zeros(3, [(name, "<f4") for name in ("x", "y", "z", "u", "v", "residual")])
    rows["u"] = [1.0, 2.0, 3.0]
    estimate = Estimate(
        rotation=np.eye(3),
        translation=np.zeros(3),
        angular_velocity=np.zeros(3),
        linear_velocity=np.zeros(3),
        inliers=np.ones(3, dtype=bool),
        residuals=np.zeros(3),
        joint_covariance=np.eye(18),
        global_shutter_inliers=3,
        iterations=1,
    )
    return Localized(
        input_stamp_ns=1_999_999_999,
        stamp_ns=-1,  # half a readout before a stamp of 0
        map_frame="hall",
        body_frame="left_eye",
        pose=Pose(rng.normal(size=3), so3.exp(rng.normal(size=3)), rng.normal(size=(6, 6))),
        twist=Twist(rng.normal(size=3), rng.normal(size=3), rng.normal(size=(6, 6))),
        inliers=rows,
        dropped=0,
        estimate=estimate,
    )


def vector(message: Any) -> list[float]:
    return [message.x, message.y, message.z]


def test_types_and_headers(frame):
    made = messages(frame, make_message)
    assert {name: message.__msgtype__ for name, message in made.items()} == TYPES
    for name, message in made.items():
        stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
        # Inliers are rows of the input: they keep its stamp.
        assert stamp == ((1, 999_999_999) if name == "inliers" else (-1, 999_999_999))
        assert message.header.frame_id == ("left_eye" if name.startswith("twist") else "hall")
    assert made["odometry"].child_frame_id == "left_eye"
    for message in made.values():
        typestore().serialize_cdr(message, message.__msgtype__)


def test_values(frame):
    made = messages(frame, make_message)
    assert frame.twist is not None
    odometry = made["odometry"]
    for pose in (made["pose"].pose, made["pose_with_covariance"].pose.pose, odometry.pose.pose):
        assert vector(pose.position) == frame.pose.position.tolist()
        x, y, z, w = *vector(pose.orientation), pose.orientation.w
        turned = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        assert np.allclose(turned, frame.pose.rotation, atol=1e-14)
    twists = (made["twist"].twist, made["twist_with_covariance"].twist.twist, odometry.twist.twist)
    for twist in twists:
        assert vector(twist.linear) == frame.twist.linear.tolist()
        assert vector(twist.angular) == frame.twist.angular.tolist()
    for message in (made["pose_with_covariance"].pose, odometry.pose):
        assert np.array_equal(message.covariance.reshape(6, 6), frame.pose.covariance)
    for message in (made["twist_with_covariance"].twist, odometry.twist):
        assert np.array_equal(message.covariance.reshape(6, 6), frame.twist.covariance)


def test_without_a_twist_nothing_claims_one(frame):
    made = messages(dataclasses.replace(frame, twist=None), make_message)
    assert set(made) == {"pose", "pose_with_covariance", "inliers"}
