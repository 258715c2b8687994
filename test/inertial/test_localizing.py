# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames with a known turn: the truth comes back whatever shakes, and nothing changes without."""

from dataclasses import fields

import numpy as np
import pytest

from rs_localizer.core.reasons import ImuReason
from rs_localizer.core.so3 import log
from rs_localizer.core.types import Estimate
from rs_localizer.inertial.gyroscope_noise import InertialSettings
from rs_localizer.inertial.status import Unused
from rs_localizer.inertial.turning import GyroscopeErrors, turn_between, turn_within
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.pose_at_time import pose_at, twist_at
from rs_localizer.tracking import Tracker

from .conftest import MIDDLE_NS, READOUT_TIME, Shaken

SETTINGS = InertialSettings(2e-4, 1e-4, True)


def errors(bias=(0.0, 0.0, 0.0), offset=0.0):
    covariance = np.diag([1e-8, 1e-8, 1e-8, 1e-10])
    return GyroscopeErrors(np.asarray(bias), offset, covariance, 1e-5)


@pytest.mark.parametrize("solver", ["r6p_vcwt", "p3p"])
def test_the_truth_comes_back_under_vibration(camera, solver):
    shaken = Shaken(vibration=0.3)
    shaken.velocity = np.zeros(3) if solver == "p3p" else shaken.velocity
    points, pixels = shaken.frame(camera)
    turn = turn_within(shaken.samples(), MIDDLE_NS, READOUT_TIME, errors()).known
    found = Localizer(camera, solver=solver).localize(points, pixels, turn=turn)
    assert found
    assert found.inliers.all()
    for tau in (-0.5, 0.0, 0.31):
        rotation, position = shaken.pose(tau * READOUT_TIME)
        pose, twist = pose_at(found, tau), twist_at(found, tau, READOUT_TIME)
        off = log(np.ascontiguousarray(pose.rotation @ rotation.as_matrix().T))
        assert np.degrees(np.linalg.norm(off)) < 2e-4
        assert np.linalg.norm(pose.position - position) < 2e-5
        assert np.degrees(np.abs(twist.angular - shaken.rate(tau * READOUT_TIME)).max()) < 0.1
        expected = rotation.inv().apply(shaken.velocity)
        np.testing.assert_allclose(twist.linear, expected, atol=2e-3)


def test_velocities_are_the_derivatives_of_the_poses(camera):
    shaken = Shaken()
    points, pixels = shaken.frame(camera)
    turn = turn_within(shaken.samples(), MIDDLE_NS, READOUT_TIME, errors()).known
    found = Localizer(camera).localize(points, pixels, turn=turn)
    step = 1e-5
    rotations, translations = found.at_rows(np.array([0.2 - step, 0.2, 0.2 + step]))
    turned = log(np.ascontiguousarray(rotations[0] @ rotations[2].T)) / (2.0 * step)
    np.testing.assert_allclose(found.angular_velocity_at(0.2), turned, atol=1e-6)
    centres = -np.einsum("nji,nj->ni", rotations, translations)
    moved = rotations[1] @ (centres[2] - centres[0]) / (2.0 * step)
    np.testing.assert_allclose(found.linear_velocity_at(0.2), moved, atol=1e-6)
    assert np.all(found.without_gyro().angular_velocity == found.angular_velocity - turn.rate)


def test_derivatives_by_bias_and_offset():
    samples = Shaken(vibration=0.02).samples(rate=397.0)  # none at the ends
    start, step = errors(), 1e-5
    within = turn_within(samples, MIDDLE_NS, READOUT_TIME, start)
    between = turn_between(samples, MIDDLE_NS - 33_000_000, MIDDLE_NS, start)
    for k in range(4):
        other = step * np.eye(4)[k]
        moved = GyroscopeErrors(other[:3], other[3], start.covariance, start.noise)
        turned = turn_between(samples, MIDDLE_NS - 33_000_000, MIDDLE_NS, moved).rotation
        by = -log(np.ascontiguousarray(turned @ between.rotation.T)) / step
        np.testing.assert_allclose(
            between.by_parameters[:, k], by, atol=2e-3 + 0.02 * abs(by).max()
        )
        known = turn_within(samples, MIDDLE_NS, READOUT_TIME, moved).known
        whole = [log(t.at(-0.5)[0] @ t.at(0.5)[0].T) for t in (known, within.known)]
        by = (whole[0] - whole[1]) / step
        np.testing.assert_allclose(
            within.by_parameters[:3, k], by, atol=2e-3 + 0.02 * abs(by).max()
        )


def test_without_samples_everything_is_as_without_a_gyroscope(camera):
    # A gentle vibration: of the same image three times a stronger one is refused, twice alike.
    points, pixels = Shaken(vibration=0.1).frame(camera)
    pixels = pixels + np.random.default_rng(0).normal(0.0, 0.5, pixels.shape)
    alone, aided = Tracker(Localizer(camera)), Tracker(Localizer(camera), SETTINGS)
    assert alone.inertial is None
    for k in range(3):
        time_ns = MIDDLE_NS + 33_000_000 * k
        one, other = (
            alone.localize(time_ns, points, pixels),
            aided.localize(time_ns, points, pixels),
        )
        for field in fields(Estimate):
            a, b = getattr(one, field.name), getattr(other, field.name)
            parts = zip(a, b, strict=True) if field.name == "scales" else [(a, b)]
            assert all(
                np.array_equal(x, y, equal_nan=field.name == "residuals") for x, y in parts
            ), field.name
        assert aided.inertial.unused == Unused(ImuReason.LATE)
