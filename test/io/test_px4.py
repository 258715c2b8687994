# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""PX4's messages say in its axes what a frame says in those of ROS."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.io.outputs import Localized, Pose, Twist
from rs_localizer.pipeline.px4 import vehicle_odometry

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
