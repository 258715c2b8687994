# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""From the axes of the IMU to those of the camera, on a fixed mounting and on one that moves."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from rs_localizer.inertial.buffer import Readings
from rs_localizer.io.bags import make_message
from rs_localizer.io.transforms import Transform, TransformError, TransformTree, make_transform
from rs_localizer.pipeline.imu import in_camera_axes

NOW = 10**18
MS = 1_000_000
EXPOSURE = (NOW, NOW + 30 * MS)
TIMES = NOW + MS * np.arange(-20, 60)
FRAMES = ("camera", "imu")
RNG = np.random.default_rng(0)


def readings(rates: Any, forces: Any = None) -> Readings:
    return Readings(TIMES, rates, forces)


def tree(samples: dict[int, Rotation], static: bool) -> TransformTree:
    found = TransformTree()
    for stamp, rotation in samples.items():
        transform = Transform(rotation.as_matrix(), np.zeros(3))
        item = make_transform(make_message, stamp, "camera", "imu", transform)
        found.add(make_message("tf2_msgs/msg/TFMessage", transforms=[item]), static=static)
    return found


def test_a_fixed_mounting_turns_rates_and_forces():
    mounting = Rotation.from_euler("xyz", [20.0, -70.0, 140.0], degrees=True)
    rates, forces = RNG.normal(size=(2, len(TIMES), 3))
    found = in_camera_axes(
        readings(rates, forces), TIMES, tree({0: mounting}, True), FRAMES, EXPOSURE, 10 * MS
    )
    np.testing.assert_allclose(found.angular_velocity, mounting.apply(rates), atol=1e-12)
    assert found.specific_force is not None
    np.testing.assert_allclose(found.specific_force, mounting.apply(forces), atol=1e-12)
    assert found.times_ns is TIMES


def test_one_frame_needs_no_transform():
    rates = RNG.normal(size=(len(TIMES), 3))
    empty = TransformTree()
    found = in_camera_axes(readings(rates), TIMES, empty, ("a", "a"), EXPOSURE, 0)
    assert found.angular_velocity is rates
    with pytest.raises(TransformError, match="does not exist"):
        in_camera_axes(readings(rates), TIMES, empty, FRAMES, EXPOSURE, 0)


def test_a_head_that_turns_the_camera_turns_its_rates():
    """An IMU that rests in the world, and a camera that turns on it: it has the camera's rate."""
    begin = Rotation.from_euler("xyz", [20.0, -70.0, 140.0], degrees=True)
    turn = np.array([0.3, -1.0, 0.5])  # rad/s, of the camera, in its own axes
    stamps = [NOW + ms * MS for ms in range(-50, 100, 10)]
    # map_from_camera(t) = begin^-1 exp(turn t), and the IMU's axes are the map's.
    mountings = {
        stamp: (begin.inv() * Rotation.from_rotvec(turn * (stamp - NOW) * 1e-9)).inv()
        for stamp in stamps
    }
    gravity = np.tile([0.0, 0.0, 9.8], (len(TIMES), 1))
    rates = np.tile([0.1, 0.2, -0.3], (len(TIMES), 1))
    found = in_camera_axes(
        readings(rates, gravity), TIMES, tree(mountings, False), FRAMES, EXPOSURE, 10 * MS
    )
    assert (found.times_ns[0], found.times_ns[-1]) == (NOW - 10 * MS, NOW + 40 * MS)
    at = Slerp([(s - NOW) * 1e-9 for s in stamps], Rotation.concatenate(list(mountings.values())))
    true = at((found.times_ns - NOW) * 1e-9)
    expected = true.apply([0.1, 0.2, -0.3]) + turn
    np.testing.assert_allclose(found.angular_velocity, expected, atol=1e-6)
    assert found.specific_force is not None
    np.testing.assert_allclose(found.specific_force, true.apply([0.0, 0.0, 9.8]), atol=1e-5)


def test_a_mounting_that_is_not_known_yet_is_none():
    old = {NOW - ms * MS: Rotation.identity() for ms in (40, 20)}
    rates = np.zeros((len(TIMES), 3))
    with pytest.raises(TransformError, match="is known from"):
        in_camera_axes(readings(rates), TIMES, tree(old, False), FRAMES, EXPOSURE, 0)
