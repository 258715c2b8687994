# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The filter of bias and offset: as the whole Kalman filter, of motion and parameters at once."""

import numpy as np
import pytest

from rs_localizer.core.shutter import Motion
from rs_localizer.inertial.filter import GyroscopeFilter, Predicted
from rs_localizer.inertial.gyroscope_noise import InertialSettings
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.turning import turn_between, turn_within

STILL = Motion(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))


def test_the_update_is_that_of_the_whole_filter():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(22, 22)) / np.r_[np.full(18, 1.0), 30.0, 30.0, 30.0, 1e3][:, None]
    joint = root @ root.T
    observed = rng.normal(size=(7, 18))  # an image that sees the motion alone
    noise = 0.1 * np.eye(7)
    seen = np.hstack([observed, np.zeros((7, 4))])
    gain = joint @ seen.T @ np.linalg.inv(seen @ joint @ seen.T + noise)
    after = joint - gain @ seen @ joint
    innovation = rng.normal(size=7)

    gyroscope = GyroscopeFilter(InertialSettings(1e-4, 1e-4, True))
    gyroscope._set(np.zeros(4), joint[18:, 18:])
    predicted = Predicted(STILL, joint[:18, :18], joint[:18, 18:])
    gyroscope.update(predicted, gain[:18] @ innovation, after[:18, :18])
    expected = gain[18:] @ innovation
    found = np.append(gyroscope.errors.bias, gyroscope.errors.time_offset)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-12)
    scale = np.sqrt(np.diag(after)[18:])
    np.testing.assert_allclose(
        gyroscope.errors.covariance / np.outer(scale, scale),
        after[18:, 18:] / np.outer(scale, scale), atol=2e-3,
    )  # fmt: skip
    np.testing.assert_allclose(gyroscope._with_motion / scale, after[:18, 18:] / scale, atol=2e-3)


@pytest.mark.parametrize("smaller", [1e-9, 1e-4, 0.5, 1.0])
def test_a_smaller_covariance_of_the_motion_leaves_all_definite(smaller):
    rng = np.random.default_rng(3)
    root = rng.normal(size=(22, 22)) / np.r_[np.full(18, 1.0), 30.0, 30.0, 30.0, 1e3][:, None]
    joint = root @ root.T
    gyroscope = GyroscopeFilter(InertialSettings(1e-4, 1e-4, True))
    gyroscope._set(np.zeros(4), joint[18:, 18:])
    gyroscope._with_motion = joint[:18, 18:].copy()
    times = np.arange(-60, 30) * 2_000_000
    samples = ImuSamples(times, rng.normal(size=(len(times), 3)))
    within = turn_within(samples, 0, 0.02, gyroscope.errors)
    between = turn_between(samples, -30_000_000, 0, gyroscope.errors)
    predicted = gyroscope.predict(STILL, smaller * joint[:18, :18], between, within, 1.5, 5.0)
    scale = np.sqrt(np.diag(predicted.covariance))
    assert np.linalg.eigvalsh(predicted.covariance / np.outer(scale, scale)).min() > 0.0
    gyroscope.update(predicted, np.zeros(18), 0.5 * predicted.covariance)
    assert np.all(np.diag(gyroscope.errors.covariance) > 0.0)
