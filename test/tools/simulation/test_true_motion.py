# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""True motions: their velocities are the derivatives of their poses, and gaps stay gaps."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.io.trajectories import Trajectory
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


MOTIONS = {
    "constant": ConstantVelocity(
        np.array([0.5, -1.5, 2.0]), np.array([1.0, -0.5, 0.25]), 4.0, start_ns=START_NS
    ),
    "smoothed": RecordedMotion(recording(np.arange(0.0, 4.0, 1 / 120))),
    "interpolated": RecordedMotion(recording(np.arange(0.0, 4.0, 1 / 120)), knot_spacing=0.0),
    "optical": RecordedMotion(recording(np.arange(0.0, 4.0, 1 / 120)), axes="optical"),
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
        np.testing.assert_allclose(state.linear[1], here.T @ velocity, atol=1e-7)
        np.testing.assert_allclose(state.angular[1], turn.as_rotvec() / (2.0 * step), atol=1e-7)


@pytest.mark.parametrize(("name", "tolerance"), [("smoothed", 1e-3), ("interpolated", 1e-6)])
def test_spline_follows_the_recording(name, tolerance):
    t = np.linspace(0.1, 3.9, 401)
    state = MOTIONS[name].state(START_NS, t)
    positions, rotations = recorded_way(t)
    expected = rotations.as_matrix() @ BODY_FROM_CAMERA["forward_left_up"]
    np.testing.assert_allclose(state.positions, positions, atol=tolerance)
    np.testing.assert_allclose(state.rotations, expected, atol=tolerance)


def test_knots_average_the_noise_of_the_recording():
    t = np.arange(0.0, 4.0, 1 / 120)
    clean, rng = recording(t), np.random.default_rng(3)
    noisy = Trajectory(
        clean.stamps_ns, clean.positions + rng.normal(0.0, 0.01, (len(t), 3)), clean.quaternions
    )
    between = t[10:-10] + 1 / 240
    truth = recorded_way(between)[0]

    def speed_error(knot_spacing: float) -> float:
        motion = RecordedMotion(noisy, "optical", knot_spacing)
        true_motion = RecordedMotion(clean, "optical", 0.0)
        state, true_state = motion.state(START_NS, between), true_motion.state(START_NS, between)
        assert np.abs(state.positions - truth).max() < 0.05
        return float(np.std(state.linear - true_state.linear))

    assert speed_error(0.05) < 0.2 * speed_error(0.0)


def test_gaps_split_the_motion():
    t = np.arange(0.0, 4.0, 1 / 120)
    t = t[(t < 1.0) | (t > 1.4)]
    t = np.delete(t, [200])  # one lost sample is no gap
    motion = RecordedMotion(recording(t))
    seconds = (np.array(motion.intervals_ns) - START_NS) * 1e-9
    np.testing.assert_allclose(seconds, [[0.0, 0.9917], [1.4083, 3.9917]], atol=1e-4)
    after = motion.state(START_NS + 1_500_000_000, np.zeros(1))
    np.testing.assert_allclose(after.positions[0], recorded_way(np.array([1.5]))[0][0], atol=1e-3)
