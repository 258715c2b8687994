# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A motion in SI units and in the map, by differences of its poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from rs_localizer.core.shutter import Motion


@pytest.mark.parametrize("tau", [0.0, -0.5, 0.3])
def test_state_is_that_of_the_poses(tau):
    rng = np.random.default_rng(0)
    turn, *vectors = rng.normal(size=(4, 3))
    motion = Motion(
        Rotation.from_rotvec(turn).as_matrix(), *vectors[:2], 0.1 * vectors[2],
        angular_acceleration=np.array([0.3, -0.2, 0.1]),
    )  # fmt: skip
    camera = rsl.Camera(640, 480, [500, 0, 319.5, 0, 500, 239.5, 0, 0, 1], readout_time=0.02)
    state, step = rsl.camera_state(motion, camera, tau), 1e-6
    places, turns = [], []
    for each in (tau - step, tau, tau + step):
        rotation, translation = motion.at(each)
        places.append(-rotation.T @ translation)
        turns.append(Rotation.from_matrix(rotation.T))
    seconds = 2.0 * step * camera.readout_time
    np.testing.assert_allclose(state.position, places[1], atol=1e-12)
    np.testing.assert_allclose(state.rotation, turns[1].as_matrix(), atol=1e-12)
    np.testing.assert_allclose(Rotation.from_quat(state.orientation).as_matrix(), state.rotation)
    velocity = (places[2] - places[0]) / seconds
    np.testing.assert_allclose(state.linear_velocity_in_map, velocity, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(state.linear_velocity, state.rotation.T @ velocity, rtol=1e-5)
    rate = (turns[2] * turns[0].inv()).as_rotvec() / seconds
    np.testing.assert_allclose(state.rotation @ state.angular_velocity, rate, rtol=1e-5, atol=1e-5)
