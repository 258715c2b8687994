# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The six messages of a frame: values, frames and stamps, and what is left out without a twist."""

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.core.types import Estimate
from rs_localizer.io.bags import make_message, typestore
from rs_localizer.io.outputs import TYPES, Localized, Pose, Twist, messages
from rs_localizer.pipeline.px4 import vehicle_odometry


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


UP = {"roll": 0.0, "pitch": 0.0, "yaw": 0.0}
# Numbers of the message: PX4-Autopilot, msg/versioned/VehicleOdometry.msg.
NED, FRD, BODY_FRD = 1, 2, 3


def localized(
    position: Any = (0.0, 0.0, 0.0),
    twist: Twist | None = None,
    pose_deviations: Any = (0.01,) * 6,
    **attitude: float,
) -> Localized:
    """A body of x forward, y left, z up in a map of x east, y north, z up."""
    angles = UP | attitude
    rotation = Rotation.from_euler("xyz", list(angles.values()), degrees=True).as_matrix()
    estimate: Any = SimpleNamespace(inliers=np.arange(10) < 8)
    pose = Pose(np.array(position), rotation, np.diag(np.square(pose_deviations)))
    return Localized(
        2_000_000_123, 2_000_000_999, "map", "base_link", pose, twist, np.zeros(0), 0, estimate
    )


def attitude(fields: dict[str, Any]) -> tuple[float, float, float]:
    """Roll (right side down), pitch (nose up), heading (clockwise from the first axis), degrees."""
    w, x, y, z = fields["q"].astype(float)
    return (
        math.degrees(math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))),
        math.degrees(math.asin(2 * (w * y - z * x))),
        math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))),
    )


def test_east_north_up_becomes_north_east_down():
    fields = vehicle_odometry(localized((1.0, 2.0, 3.0)), "ned", 0, 0)
    assert fields["pose_frame"] == NED
    np.testing.assert_allclose(fields["position"], [2.0, 1.0, -3.0])
    assert attitude(fields) == pytest.approx((0.0, 0.0, 90.0))  # it looks east


def test_variances_are_those_of_the_errors():
    """Of poses drawn from the covariance: positions in the world, turns about the body's axes."""
    rng = np.random.default_rng(3)
    root = 0.01 * rng.normal(size=(6, 6))
    frame = localized((1.0, 2.0, 3.0), yaw=40.0, pitch=20.0, roll=-10.0)
    pose = frame.pose
    drawn = []
    for error in rng.normal(size=(4000, 6)) @ root.T:
        turn = Rotation.from_rotvec(error[3:]).as_matrix()
        other = localized(pose.position + error[:3])
        object.__setattr__(other.pose, "rotation", turn @ pose.rotation)
        drawn.append(vehicle_odometry(other, "ned", 0, 0))
    object.__setattr__(pose, "covariance", root @ root.T)
    fields = vehicle_odometry(frame, "ned", 0, 0)
    positions = np.array([other["position"] for other in drawn], dtype=float)
    np.testing.assert_allclose(positions.var(axis=0), fields["position_variance"], rtol=0.1)
    here = rotation_of(fields)
    turns = [(here.inv() * rotation_of(other)).as_rotvec() for other in drawn]
    np.testing.assert_allclose(np.var(turns, axis=0), fields["orientation_variance"], rtol=0.1)


def rotation_of(fields: dict[str, Any]) -> Rotation:
    """PX4's quaternions begin with the scalar."""
    return Rotation.from_quat(np.roll(fields["q"].astype(float), -1))


def test_times_quality_and_resets():
    fields = vehicle_odometry(localized(), "frd", 257, 2_050_000_000)
    assert (fields["timestamp"], fields["timestamp_sample"]) == (2_050_000, 2_000_000)
    assert fields["quality"] == 80  # percent of the points
    assert fields["reset_counter"] == 1  # a uint8
    assert abs(np.linalg.norm(fields["q"]) - 1.0) < 1e-6  # EKF2 takes 1e-5
    none = localized()
    none.estimate.inliers[:] = False
    assert vehicle_odometry(none, "frd", 0, 0)["quality"] == 1  # 0 would be invalid
