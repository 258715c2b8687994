# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Odometry in PX4's axes, by the definitions of both; and which poses are jumps."""

from typing import Any

import numpy as np
import px4_odometry
import pytest
from px4_odometry import vehicle_odometry
from scipy.spatial.transform import Rotation

from rs_localizer.io.bags import make_message
from rs_localizer.io.outputs import Localized, Pose, Twist, messages

NED = 1  # PX4-Autopilot, msg/versioned/VehicleOdometry.msg
PERIOD = 1 / 30


def odometry(
    position: Any = (0.0, 0.0, 0.0),
    turn: Any = (0.0, 0.0, 0.0),
    covariance: Any = None,
    seconds: float = 2.000000999,
) -> Any:
    """Of a body of x forward, y left, z up; 1 cm, 0.1 m/s."""
    unused: Any = None
    covariance = np.diag([1e-4] * 3 + [7.6e-5] * 3) if covariance is None else covariance
    pose = Pose(np.array(position), Rotation.from_rotvec(turn).as_matrix(), covariance)
    twist = Twist(np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3]), 1e-2 * np.eye(6))
    stamp, rows = round(1e9 * seconds), np.zeros(0, [("x", "<f4")])
    frame = Localized(stamp, stamp, "map", "base_link", pose, twist, rows, 0, unused)
    return messages(frame, make_message)["odometry"]


def rotation_of(fields: dict[str, Any]) -> Rotation:
    """PX4's quaternions begin with the scalar."""
    return Rotation.from_quat(np.roll(fields["q"].astype(float), -1))


def test_east_north_up_becomes_north_east_down():
    fields = vehicle_odometry(odometry((1.0, 2.0, 3.0)), "ned", 257, 2_050_000_000)
    assert fields["pose_frame"] == NED
    np.testing.assert_allclose(fields["position"], [2.0, 1.0, -3.0])
    # It looks east, and its third axis is down.
    np.testing.assert_allclose(rotation_of(fields).as_matrix()[:, 0], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(rotation_of(fields).as_matrix()[:, 2], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(fields["velocity"], [1.0, -2.0, -3.0])
    np.testing.assert_allclose(fields["angular_velocity"], [0.1, -0.2, -0.3], rtol=1e-6)
    assert (fields["timestamp"], fields["timestamp_sample"]) == (2_050_000, 2_000_000)
    assert fields["reset_counter"] == 1  # a uint8
    assert abs(np.linalg.norm(fields["q"]) - 1.0) < 1e-6  # EKF2 takes 1e-5


def test_variances_are_those_of_the_errors():
    """Of poses drawn from the covariance: positions in the world, turns about the body's axes."""
    rng = np.random.default_rng(3)
    root = 0.01 * rng.normal(size=(6, 6))
    turn = Rotation.from_euler("xyz", [-10.0, 20.0, 40.0], degrees=True)
    fields = [
        vehicle_odometry(
            odometry(error[:3], (Rotation.from_rotvec(error[3:]) * turn).as_rotvec()), "ned", 0, 0
        )
        for error in rng.normal(size=(2000, 6)) @ root.T
    ]
    told = vehicle_odometry(odometry(turn=turn.as_rotvec(), covariance=root @ root.T), "ned", 0, 0)
    positions = np.array([one["position"] for one in fields], dtype=float)
    np.testing.assert_allclose(positions.var(axis=0), told["position_variance"], rtol=0.15)
    turns = [(rotation_of(told).inv() * rotation_of(one)).as_rotvec() for one in fields]
    np.testing.assert_allclose(np.var(turns, axis=0), told["orientation_variance"], rtol=0.15)


@pytest.mark.parametrize(
    ("seconds", "position", "jumps"),
    [
        (PERIOD, [PERIOD, 2 * PERIOD, 3 * PERIOD], False),  # it goes on as it moved
        (PERIOD, [0.3, 0.0, 0.0], True),  # a step that nobody makes
        (1.0, [1.5, 2.5, 2.0], False),  # after a gap it may be elsewhere
        (-1.0, [0.0, 0.0, 0.0], True),  # a clock that goes back
    ],
)
def test_jumps(seconds, position, jumps):
    last = odometry(seconds=10.0)
    assert px4_odometry.jumps(last, odometry(position, seconds=10.0 + seconds)) == jumps
