# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors in sigmas against independent truth, and the scenes that they are measured on."""

import numpy as np

from benchmarks.experiments.trials import Setting
from benchmarks.experiments.views import View, synthetic_views
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.estimation.refine import apply_step

MOVING = Setting(angular=15.0, linear=0.15, noise=1.0)


def moved(motion: Motion, step: np.ndarray) -> Motion:
    """The motion one step (12,) further on."""
    state = np.concatenate(
        [motion.rotation.ravel(), motion.translation, motion.angular_velocity,
         motion.linear_velocity, motion.angular_acceleration, motion.linear_acceleration]
    )  # fmt: skip
    state = apply_step(state, step)
    return Motion(state[:9].reshape(3, 3), state[9:12], state[12:15], state[15:18],
                  angular_acceleration=state[18:21], linear_acceleration=state[21:])  # fmt: skip


def view() -> View:
    return next(synthetic_views(1, 5, MOVING, outliers=0.4))


def test_views_are_seen_at_their_own_row():
    one = view()
    pixels, _ = project_rolling(one.camera, one.motion.at_rows, one.points)
    np.testing.assert_allclose(one.true_pixels, pixels, atol=1e-6)
    off = (one.pixels - one.true_pixels)[one.inliers]
    assert 0.7 < off.std() < 1.3
    assert np.count_nonzero(~one.inliers) == 20
    assert np.abs(one.pixels - one.true_pixels)[~one.inliers].max() > 100.0


def test_the_bound_is_that_of_finite_differences():
    one = view()
    h, columns = 1e-5, []
    for k in range(12):
        ahead, behind = (
            project_rolling(one.camera, moved(one.motion, s * h * np.eye(12)[k]).at_rows,
                            one.points[one.inliers])[0]
            for s in (1.0, -1.0)
        )  # fmt: skip
        columns.append(((ahead - behind) / (2.0 * h)).ravel())
    jacobian = np.column_stack(columns)
    expected = jacobian.T @ jacobian
    np.testing.assert_allclose(one.information(), expected, rtol=1e-4, atol=1e-5 * expected.max())
