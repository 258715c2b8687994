# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The prior of the accelerations against dense covariances, and what an estimate says of them."""

import numpy as np
import projector
from scipy.linalg import toeplitz
from scipy.spatial.transform import Rotation

from rs_localizer.tools.adjust.motion import acceleration_rows
from rs_localizer.tools.adjust.spline import Layout, Spline
from rs_localizer.tools.adjust.variables import Freedom

SPACING, ANGULAR, LINEAR, FADING = 0.04, 3.0, 2.0, 0.1


def two_stretches() -> Spline:
    """Of seven and of five controls."""
    motion = projector.Motion.random(np.random.default_rng(0))
    layout = Layout.over(np.array([[0.0, 4 * SPACING], [1.0, 1.0 + 2 * SPACING]]), SPACING)
    return Spline(layout, *motion.pose(layout.control_times()))


def by_hand(spline: Spline, fading: float) -> float:
    """Squares of the accelerations at the controls in units of their covariance."""
    cost = 0.0
    for part in (slice(0, 7), slice(7, 12)):
        turns = Rotation.from_matrix(spline.rotations[part])
        steps = (turns[:-1].inv() * turns[1:]).as_rotvec()
        angular = np.diff(steps, axis=0) / SPACING**2
        linear = np.diff(spline.positions[part], 2, axis=0) / SPACING**2
        apart = np.arange(len(linear)) * SPACING
        correlation = np.exp(-apart / fading) if fading else (apart == 0.0).astype(float)
        inverse = np.linalg.inv(toeplitz(correlation))
        cost += np.sum(angular * (inverse @ angular)) / ANGULAR**2
        cost += np.sum(linear * (inverse @ linear)) / LINEAR**2
    return float(cost)


def test_the_prior_is_that_of_accelerations_that_fade():
    spline = two_stretches()
    for fading in (0.0, FADING):
        freedom = Freedom(angular_acceleration=ANGULAR, linear_acceleration=LINEAR, fading=fading)
        rows = acceleration_rows(spline, freedom.accelerations(SPACING))
        np.testing.assert_allclose(rows.cost, by_hand(spline, fading), rtol=1e-9)
        np.testing.assert_allclose(rows.cost, np.sum(rows.errors**2), rtol=1e-12)
