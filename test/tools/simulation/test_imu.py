# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulated IMU against the motion itself: what it measures, integrated, is the motion."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer import data
from rs_localizer.io.trajectories import read_tum
from rs_localizer.tools.simulation.simulated_imu import ImuSettings, Lever, Shaken, simulate_imu
from rs_localizer.tools.simulation.true_motion import RecordedMotion

PERFECT = ImuSettings(2000.0, 0.0, 0.0, 0.0, 0.0, 0.0)
CAMERA_FROM_IMU = Rotation.from_euler("xyz", [20.0, -70.0, 140.0], degrees=True).as_matrix()
LEVER = Lever(CAMERA_FROM_IMU, np.array([0.1, -0.05, 0.02]))
RNG = np.random.default_rng(0)


def test_the_motion_comes_back_when_it_is_integrated():
    """Dead reckoning by the midpoint rule, over a second of a hand that shakes."""
    hand = RecordedMotion(read_tum(data.path(data.HAND_MOTION)).part(slice(0, 300)))
    motion = Shaken(hand, math.radians(0.3), 60.0, np.array([0.6, 0.0, 0.8]), 1.0)
    first = hand.intervals_ns[0][0]
    track = simulate_imu(motion, PERFECT, LEVER, RNG)
    count = 2001
    start = motion.state(first, np.zeros(1))
    map_from_imu = Rotation.from_matrix(start.rotations[0] @ CAMERA_FROM_IMU)
    place = start.positions[0] + start.rotations[0] @ LEVER.position
    speed = start.rotations[0] @ (start.linear[0] + np.cross(start.angular[0], LEVER.position))
    gravity = np.array([0.0, 0.0, -9.80665])
    dt = 1.0 / PERFECT.rate
    for i in range(count - 1):
        rate = 0.5 * (track.angular_velocities[i] + track.angular_velocities[i + 1])
        halfway = map_from_imu * Rotation.from_rotvec(0.5 * dt * rate)
        force = 0.5 * (track.specific_forces[i] + track.specific_forces[i + 1])
        pull = halfway.apply(force) + gravity
        place, speed = place + dt * speed + 0.5 * dt**2 * pull, speed + dt * pull
        map_from_imu = map_from_imu * Rotation.from_rotvec(dt * rate)
    end = motion.state(int(track.times_ns[count - 1]), np.zeros(1))
    turned = Rotation.from_matrix(end.rotations[0] @ CAMERA_FROM_IMU)
    assert (turned.inv() * map_from_imu).magnitude() < math.radians(0.01)
    there = end.positions[0] + end.rotations[0] @ LEVER.position
    assert np.linalg.norm(place - there) < 1e-3
    assert np.linalg.norm(there - start.positions[0]) > 0.1  # it has been somewhere
