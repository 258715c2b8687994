# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Gravity by an accelerometer."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.inertial.gyro_prior import STANDARD_GRAVITY, gravity_seen
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.turning import GyroscopeErrors

ERRORS = GyroscopeErrors(np.zeros(10), 1e-8 * np.eye(10), 1e-4)
TIMES = 10**12 + np.arange(400) * 2_500_000


def test_gravity_of_a_camera_that_turns():
    rate = np.array([0.2, -0.5, 0.3])
    seconds = 1e-9 * (TIMES - TIMES[200])
    down = np.array([0.0, 0.6, 0.8])
    force = Rotation.from_rotvec(np.outer(seconds, rate)).inv().apply(-STANDARD_GRAVITY * down)
    samples = ImuSamples(TIMES, np.broadcast_to(rate, (400, 3)), force)
    found, deviation = gravity_seen(samples, int(TIMES[200]), ERRORS)
    np.testing.assert_allclose(found, down, atol=1e-5)
    assert deviation == pytest.approx(0.03, rel=1e-3)


def test_a_camera_that_accelerates_knows_gravity_less():
    seconds = 1e-9 * (TIMES - TIMES[200])
    still = np.broadcast_to([0.0, -STANDARD_GRAVITY, 0.0], (400, 3))
    pushed = still + np.outer(np.sin(2.0 * np.pi * 3.0 * seconds), [3.0, 0.0, 0.0])
    rates = np.zeros((400, 3))
    calm, pushed, falling, without = (
        gravity_seen(ImuSamples(TIMES, rates, *force), int(TIMES[200]), ERRORS)
        for force in ([still], [pushed], [0.1 * still], [])
    )
    direction, deviation = pushed
    assert deviation > 3.0 * calm[1]
    assert np.arccos(min(direction @ [0.0, 1.0, 0.0], 1.0)) < 2.0 * deviation
    assert falling is None
    assert without is None
