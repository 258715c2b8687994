# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rolling-shutter frames for the tests of the core, made by forward projection."""

from types import SimpleNamespace

import numpy as np
import pytest

from rs_localizer.core import so3
from rs_localizer.core.camera import Camera
from rs_localizer.core.rig import Mounts
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.estimation.points import Observations
from rs_localizer.estimation.prior import state_in

K = np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]])


def state_of(motion):
    return state_in(motion, np.zeros(3))


def motion_of(state):
    return Motion(
        state[:9].reshape(3, 3), state[9:12], state[12:15], state[15:18],
        angular_acceleration=state[18:21], linear_acceleration=state[21:24],
    )  # fmt: skip


def frame(direction="top_to_bottom", speed=0.15, noise=0.0, count=21, seed=0, acceleration=0.0):
    """Camera, motion, points, true pixels, measured pixels."""
    rng = np.random.default_rng(seed)
    faster = acceleration * np.random.default_rng(seed + 1000).normal(size=(2, 3))
    camera = Camera(640, 480, K, [-0.15, 0.03, 0.001, 0.002, 0.0], scan_direction=direction)
    motion = Motion(
        so3.exp(rng.normal(size=3)),
        np.array([0.05, -0.1, 4.0]),
        speed * rng.normal(size=3),
        speed * rng.normal(size=3),
        angular_acceleration=faster[0],
        linear_acceleration=faster[1],
    )
    points = rng.uniform(-1, 1, (4 * count, 3))
    true, _ = project_rolling(camera, motion.at_rows, points)
    seen = np.flatnonzero(camera.inside(true))[:count]
    assert len(seen) == count
    points, true = points[seen], true[seen]
    return camera, motion, points, true, true + noise * rng.normal(size=true.shape)


def observe(camera, points, pixels, gradient=None):
    rays = camera.rays(pixels)
    mounts = Mounts.one(camera.row_time_gradient if gradient is None else gradient)
    return Observations.of(
        points, rays, camera.row_time(pixels), camera.pixel_jacobian(rays), mounts
    )


def pack(camera, points, pixels, gradient=None):
    return observe(camera, points, pixels, gradient).packed


@pytest.fixture
def scene():
    return SimpleNamespace(
        frame=frame, observe=observe, pack=pack, state_of=state_of, motion_of=motion_of
    )
