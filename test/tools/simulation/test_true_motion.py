# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""True motions: their velocities are the derivatives of their poses, and gaps stay gaps."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.io.trajectories import Trajectory
from rs_localizer.tools.simulation.simulated_imu import shaken
from rs_localizer.tools.simulation.simulated_recording import MountedMotion
from rs_localizer.tools.simulation.simulated_settings import BODY_FROM_CAMERA
from rs_localizer.tools.simulation.true_motion import ConstantVelocity, RecordedMotion, TrueMotion

START_NS = 1_520_531_467_575_280_000


def recorded_way(t: Array) -> tuple[Array, Rotation]:
    """A lively smooth motion in closed form."""
    positions = np.stack([np.sin(2.0 * t), 0.5 * np.cos(3.0 * t), 0.2 * t], axis=1)
    vectors = np.stack([0.8 * np.sin(2.5 * t), 0.6 * np.cos(2.0 * t), 1.5 * t], axis=1)
    return positions, Rotation.from_rotvec(vectors)


def recording(t: Array) -> Trajectory:
    positions, rotations = recorded_way(t)
    quaternions = rotations.as_quat()
    quaternions[::3] *= -1.0  # q and -q are the same rotation
    return Trajectory(START_NS + np.round(t * 1e9).astype(np.int64), positions, quaternions)


STEADY = ConstantVelocity(
    np.array([0.5, -1.5, 2.0]), np.array([1.0, -0.5, 0.25]), 4.0, start_ns=START_NS
)
TURN = Rotation.from_euler("xyz", [0.1, -0.2, np.pi]).as_matrix()
PLACE = np.array([0.1, -0.2, 0.05])
MOTIONS = {
    "constant": STEADY,
    "shaken": shaken(STEADY, [(0.3, 60.0), (0.1, 120.0)], np.random.default_rng(2)),
    "mounted": MountedMotion(STEADY, TURN, PLACE),
    "smoothed": RecordedMotion(recording(np.arange(0.0, 4.0, 1 / 120))),
    "interpolated": RecordedMotion(recording(np.arange(0.0, 4.0, 1 / 39))),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_velocities_are_the_derivatives_of_the_poses(name):
    motion: TrueMotion = MOTIONS[name]
    step = 1e-5
    for seconds in (0.5, 1.7, 3.1):
        stamp_ns = START_NS + round(seconds * 1e9)
        state = motion.state(stamp_ns, np.array([-step, 0.0, step]))
        here = state.rotations[1]
        velocity = (state.positions[2] - state.positions[0]) / (2.0 * step)
        turn = Rotation.from_matrix(state.rotations[0].T @ state.rotations[2])
        within = 1e-4 if name == "shaken" else 1e-7
        np.testing.assert_allclose(state.linear[1], here.T @ velocity, atol=within)
        np.testing.assert_allclose(state.angular[1], turn.as_rotvec() / (2.0 * step), atol=within)


@pytest.mark.parametrize(("name", "tolerance"), [("smoothed", 1e-3), ("interpolated", 1e-6)])
def test_spline_follows_the_recording(name, tolerance):
    t = np.linspace(0.1, 3.9, 401)
    state = MOTIONS[name].state(START_NS, t)
    positions, rotations = recorded_way(t)
    expected = rotations.as_matrix() @ BODY_FROM_CAMERA
    np.testing.assert_allclose(state.positions, positions, atol=tolerance)
    np.testing.assert_allclose(state.rotations, expected, atol=tolerance)


def test_a_shaken_camera_turns_as_far_as_its_tones():
    times = np.linspace(0.0, 2.0, 4000)
    still, swung = (
        MOTIONS[name].state(START_NS, times).rotations for name in ("constant", "shaken")
    )
    angles = Rotation.from_matrix(np.swapaxes(still, 1, 2) @ swung).magnitude()
    assert np.radians(0.3) < angles.max() <= np.radians(0.4001)


def test_a_mounted_camera_sees_points_where_its_rig_carries_it():
    point = np.array([1.0, 2.0, 3.0])
    rig, camera = (
        MOTIONS[name].state(START_NS, np.array([0.4])) for name in ("constant", "mounted")
    )
    in_rig, in_camera = (
        state.rotations[0].T @ (point - state.positions[0]) for state in (rig, camera)
    )
    np.testing.assert_allclose(in_camera, TURN @ in_rig + PLACE, atol=1e-12)
