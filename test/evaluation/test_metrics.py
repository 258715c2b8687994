# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of known size are found, and only frames of the same time are compared."""

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.evaluation.metrics import associate, pose_errors, twist_errors
from rs_localizer.io.trajectories import Trajectory, Twists

RNG = np.random.default_rng(0)
STAMPS = 1_500_000_000_000_000_000 + np.arange(10, dtype=np.int64) * 33_333_333
ROTATIONS = Rotation.from_quat(RNG.normal(size=(10, 4)))
TRUTH = Trajectory(STAMPS, RNG.normal(size=(10, 3)), ROTATIONS.as_quat())


def test_associate_takes_the_nearest_within_the_tolerance():
    true = np.array([10, 20, 30, 40], np.int64)
    estimated = np.array([0, 8, 16, 25, 30, 33, 47], np.int64)
    rows, true_rows = associate(estimated, true, 5)
    assert rows.tolist() == [1, 2, 3, 4, 5]
    assert true_rows.tolist() == [0, 1, 1, 2, 2]
    rows, true_rows = associate(estimated, true, 0)
    assert (rows.tolist(), true_rows.tolist()) == ([4], [2])


def test_pose_errors_are_in_metres_and_degrees():
    # Rotations about different axes by 5 degrees, in the body's own axes; a sign means nothing.
    axes = RNG.normal(size=(10, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turned = Rotation.from_quat(TRUTH.quaternions) * Rotation.from_rotvec(np.radians(5.0) * axes)
    moved = Trajectory(STAMPS, TRUTH.positions + 0.02 * axes, -turned.as_quat())
    errors = pose_errors(moved, TRUTH)
    np.testing.assert_allclose(errors.linear, 0.02)
    np.testing.assert_allclose(errors.angular, 5.0)
    np.testing.assert_array_equal(errors.stamps_ns, STAMPS)
    assert len(pose_errors(moved.part(slice(3, 6)), TRUTH).linear) == 3


def test_twist_errors():
    angular, linear = RNG.normal(size=(10, 3)), RNG.normal(size=(10, 3))
    true = Twists(STAMPS, angular, linear)
    off = Twists(STAMPS, angular + np.array([0.0, 0.03, 0.04]), linear - np.array([0.6, 0, 0.8]))
    errors = twist_errors(off, true)
    np.testing.assert_allclose(errors.angular, np.degrees(0.05))
    np.testing.assert_allclose(errors.linear, 1.0)
    np.testing.assert_allclose(
        errors.true_angular_rate, np.degrees(np.linalg.norm(angular, axis=1))
    )
