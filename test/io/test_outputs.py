# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The six messages of a frame: values, frames and stamps, and what is left out without a twist."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.io.bags import make_message, typestore
from rs_localizer.io.outputs import TYPES, Localized, Pose, Twist, messages
from rs_localizer.pipeline.px4 import vehicle_odometry


@pytest.fixture
def frame() -> Localized:
    rng = np.random.default_rng(1)
    rows = np.zeros(3, [(name, "<f4") for name in ("x", "y", "z", "u", "v", "residual")])
    pose = Pose(rng.normal(size=3), so3.exp(rng.normal(size=3)), rng.normal(size=(6, 6)))
    twist = Twist(rng.normal(size=3), rng.normal(size=3), rng.normal(size=(6, 6)))
    # The stamp is half a readout before one of 0.
    return Localized(1_999_999_999, -1, "hall", "left_eye", pose, twist, rows, 0, None)


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
    odometry = made["odometry"]
    for pose in (made["pose"].pose, made["pose_with_covariance"].pose.pose, odometry.pose.pose):
        assert vector(pose.position) == frame.pose.position.tolist()
        turned = Rotation.from_quat([*vector(pose.orientation), pose.orientation.w])
        np.testing.assert_allclose(turned.as_matrix(), frame.pose.rotation, atol=1e-14)
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


# Numbers of the message: PX4-Autopilot, msg/versioned/VehicleOdometry.msg.
NED = 1


def localized(position: Any = (0.0, 0.0, 0.0), rotation: Any = None) -> Localized:
    """A body of x forward, y left, z up in a map of x east, y north, z up."""
    estimate = SimpleNamespace(inliers=np.arange(10) < 8)
    pose = Pose(np.array(position), np.eye(3) if rotation is None else rotation, 1e-4 * np.eye(6))
    return Localized(
        2_000_000_123, 2_000_000_999, "map", "base_link", pose, None, np.zeros(0), 0, estimate
    )


def rotation_of(fields: dict[str, Any]) -> Rotation:
    """PX4's quaternions begin with the scalar."""
    return Rotation.from_quat(np.roll(fields["q"].astype(float), -1))


def test_east_north_up_becomes_north_east_down():
    fields = vehicle_odometry(localized((1.0, 2.0, 3.0)), "ned", 0, 0)
    assert fields["pose_frame"] == NED
    np.testing.assert_allclose(fields["position"], [2.0, 1.0, -3.0])
    # It looks east, and its third axis is down.
    np.testing.assert_allclose(rotation_of(fields).as_matrix()[:, 0], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(rotation_of(fields).as_matrix()[:, 2], [0, 0, 1], atol=1e-6)


def test_variances_are_those_of_the_errors():
    """Of poses drawn from the covariance: positions in the world, turns about the body's axes."""
    rng = np.random.default_rng(3)
    root = 0.01 * rng.normal(size=(6, 6))
    turn = Rotation.from_euler("xyz", [-10.0, 20.0, 40.0], degrees=True)
    fields = []
    for error in rng.normal(size=(2000, 6)) @ root.T:
        turned = Rotation.from_rotvec(error[3:]) * turn
        fields.append(vehicle_odometry(localized(error[:3], turned.as_matrix()), "ned", 0, 0))
    frame = localized(rotation=turn.as_matrix())
    object.__setattr__(frame.pose, "covariance", root @ root.T)
    told = vehicle_odometry(frame, "ned", 0, 0)
    positions = np.array([one["position"] for one in fields], dtype=float)
    np.testing.assert_allclose(positions.var(axis=0), told["position_variance"], rtol=0.15)
    turns = [(rotation_of(told).inv() * rotation_of(one)).as_rotvec() for one in fields]
    np.testing.assert_allclose(np.var(turns, axis=0), told["orientation_variance"], rtol=0.15)


def test_times_quality_and_resets():
    fields = vehicle_odometry(localized(), "frd", 257, 2_050_000_000)
    assert (fields["timestamp"], fields["timestamp_sample"]) == (2_050_000, 2_000_000)
    assert fields["quality"] == 80  # percent of the points
    assert fields["reset_counter"] == 1  # a uint8
    assert abs(np.linalg.norm(fields["q"]) - 1.0) < 1e-6  # EKF2 takes 1e-5
    none = localized()
    none.estimate.inliers[:] = False
    assert vehicle_odometry(none, "frd", 0, 0)["quality"] == 1  # 0 would be invalid
