# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The filter of robot_localization, and that it may believe what we publish."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import fusion
from benchmarks.ekf import ANGULAR, LINEAR, Ekf, nees
from rs_localizer.io.outputs import Pose, Twist


def ekf(covariance: np.ndarray) -> Ekf:
    pose = Pose(np.zeros(3), np.eye(3), covariance)
    return Ekf(np.full(15, 1e-4), pose, (1.0, 1.0), 1.0)


def test_its_motion_model_is_a_screw():
    filtered = ekf(1e-4 * np.eye(6))
    filtered.state[LINEAR], filtered.state[ANGULAR] = [1.0, 0.5, -0.2], [0.3, -0.2, 0.6]
    position, rotation = np.zeros(3), Rotation.identity()
    for _ in range(200):
        filtered.predict(5e-3)
        position = position + 5e-3 * rotation.apply([1.0, 0.5, -0.2])
        rotation = rotation * Rotation.from_rotvec([1.5e-3, -1e-3, 3e-3])
    error = filtered.error(
        position, rotation.as_matrix(), np.array([1.0, 0.5, -0.2]), np.array([0.3, -0.2, 0.6])
    )
    assert np.abs(error).max() < 5e-3


def test_measurements_are_weighed_as_two_averages():
    filtered = ekf(np.diag([4.0] * 6))
    filtered.correct_pose(Pose(np.ones(3), np.eye(3), np.diag([1.0] * 6)))
    np.testing.assert_allclose(filtered.state[:3], 0.8)
    np.testing.assert_allclose(np.diag(filtered.covariance)[:6], 0.8)
    filtered.correct_twist(Twist(np.ones(3), 2.0 * np.ones(3), np.eye(6)), linear=False)
    np.testing.assert_allclose(filtered.state[6:12], [0.0] * 3 + [1.0] * 3)
    assert nees(np.ones(2), np.diag([1.0, 4.0])) == 1.25


@pytest.fixture(scope="module")
def flights() -> tuple[fusion.Frames, fusion.Outputs]:
    frames = fusion.fly(8, 70, 0)
    return frames, fusion.outputs(frames, tracking=False)


@pytest.mark.bench
def test_poses_of_single_frames_make_a_consistent_filter(flights):
    choice = next(one for one in fusion.CHOICES if one.name == "pose, tracking off")
    fused = fusion.fuse(*flights, choice)
    low, high = fused.band
    assert low < fused.pose.mean() < high
    assert fused.inside > 0.8
    assert fused.velocity.mean() < 9.0


@pytest.mark.bench
def test_covariances_about_fixed_axes_are_no_covariances_of_angles(flights):
    """Without roll_pitch_yaw the filter is too sure, and the check sees it."""
    choice = next(one for one in fusion.CHOICES if not one.angles)
    fused = fusion.fuse(*flights, choice)
    assert fused.pose.mean() > fused.band[1]
    assert fused.inside < 0.7
