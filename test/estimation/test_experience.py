# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What frames say that goes to the next one."""

from itertools import pairwise

import numpy as np

from rs_localizer.config import VelocityPrior
from rs_localizer.core import so3
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.experience import Experience


def estimate_at(position, deviation=1e-3, turn=0.0):
    nothing = np.zeros(3)
    rotation = so3.exp(np.array([0.0, turn, 0.0]))
    return Estimate(
        rotation, -rotation @ position, nothing, nothing, inliers=np.ones(12, dtype=bool),
        residuals=np.zeros(12), joint_covariance=deviation**2 * np.eye(18),
        iterations=0,
    )  # fmt: skip


def speeds_after(metres, radians, deviation=1e-3):
    """Odds of typical speeds after ten images, each so much farther than the one before."""
    images = [
        estimate_at(np.array([k * metres, 0.0, 0.0]), deviation, k * radians) for k in range(10)
    ]
    experience = Experience.of(images[0])
    for before, after in pairwise(images):
        experience = experience.moving(
            experience.scales.speeds, before, after, 1.0 / 30.0, VelocityPrior()
        )
    return experience


def test_images_tell_how_fast_cameras_move_within_them():
    calm, drone = speeds_after(0.003, 0.005), speeds_after(0.1, 0.2)  # 0.15 and 6 rad/s
    assert calm.scales.speeds.max() == 0.0
    assert np.argmax(calm.scales.speeds[1:]) == 0
    assert calm.scales.speeds[-1] == -9.0  # not less: a camera may start to move
    assert np.argmax(drone.scales.speeds) == 2
    assert drone.scales.speeds[0] == drone.scales.speeds[1] < -3.0
    # A shutter may be a global one, and poses that are hardly known tell nothing.
    assert calm.scales.speeds[0] == calm.scales.speeds[1]
    assert np.abs(speeds_after(0.003, 0.005, 1.0).scales.speeds).max() < 0.3
