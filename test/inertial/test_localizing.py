# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames with a known turn: the truth comes back whatever shakes, and nothing changes without."""

from dataclasses import fields

import numpy as np
import pytest

from rs_localizer.core.reasons import ImuReason
from rs_localizer.core.so3 import log
from rs_localizer.core.types import Estimate
from rs_localizer.inertial.status import InertialSettings, Unused
from rs_localizer.inertial.turning import GyroscopeErrors, rotated
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.pose_at_time import pose_at, twist_at
from rs_localizer.tracking import Tracker

from .conftest import MIDDLE_NS, READOUT_TIME, Shaken

SETTINGS = InertialSettings(2e-4, 1e-4)


def errors(mean=(0.0,) * 10):
    covariance = np.diag([1e-8, 1e-8, 1e-8, 1e-10, *6 * [1e-8]])
    return GyroscopeErrors(np.asarray(mean), covariance, 1e-5)


@pytest.mark.parametrize("solver", ["r6p_vcwt", "p3p"])
def test_the_truth_comes_back_under_vibration(camera, solver):
    shaken = Shaken(vibration=0.3)
    shaken.velocity = np.zeros(3) if solver == "p3p" else shaken.velocity
    points, pixels = shaken.frame(camera)
    turn = rotated(shaken.samples(), MIDDLE_NS, READOUT_TIME, errors()).known
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
    turn = rotated(shaken.samples(), MIDDLE_NS, READOUT_TIME, errors()).known
    found = Localizer(camera).localize(points, pixels, turn=turn)
    step = 1e-5
    rotations, translations = found.at_rows(np.array([0.2 - step, 0.2, 0.2 + step]))
    turned = log(np.ascontiguousarray(rotations[0] @ rotations[2].T)) / (2.0 * step)
    np.testing.assert_allclose(found.angular_velocity_at(0.2), turned, atol=1e-6)
    centres = -np.einsum("nji,nj->ni", rotations, translations)
    moved = rotations[1] @ (centres[2] - centres[0]) / (2.0 * step)
    np.testing.assert_allclose(found.linear_velocity_at(0.2), moved, atol=1e-6)
    assert np.all(found.without_gyro().angular_velocity == found.angular_velocity - turn.rate)


@pytest.mark.parametrize("far", [0.0, 0.1])
def test_derivatives_by_what_the_gyroscope_is_off_by(far):
    """By differences, from none of it and from a scale and a mount that are far off."""
    samples = Shaken(vibration=0.02).samples(rate=397.0)  # none at the ends
    start, step, since = errors(far * np.r_[0, 0, 0, 0, 1, -1, 0.5, 0.6, 0.5, -1]), 1e-5, 33_000_000
    found = rotated(samples, MIDDLE_NS, READOUT_TIME, start, MIDDLE_NS - since)
    for k in range(10):
        moved = errors(start.mean + step * np.eye(10)[k])
        other = rotated(samples, MIDDLE_NS, READOUT_TIME, moved, MIDDLE_NS - since)
        by = -log(np.ascontiguousarray(other.between @ found.between.T)) / step
        np.testing.assert_allclose(
            found.by_errors[:3, k], by, atol=3e-3 + 0.02 * abs(by).max(), err_msg=str(k)
        )
        whole = [log(t.known.at(-0.5)[0] @ t.known.at(0.5)[0].T) for t in (other, found)]
        by = (whole[0] - whole[1]) / step
        np.testing.assert_allclose(
            found.by_errors[3:6, k], by, atol=3e-3 + 0.02 * abs(by).max(), err_msg=str(k)
        )


def test_a_vibration_of_unknown_phase_is_no_rotation_that_is_known():
    """Averaged over its period it vanishes; what is left counts as vibration without a phase."""
    shaken = Shaken(vibration=0.3, turn=0.0)
    samples = shaken.samples(rate=400.0, reach=0.2)
    known, vague = errors(), errors()
    vague.covariance[3, 3] = 0.02**2
    sure, unsure = (rotated(samples, MIDDLE_NS, READOUT_TIME, one) for one in (known, vague))
    swing = np.radians(0.3) / np.sqrt(2.0)
    fastest = [
        np.abs(one.known.at_rows(np.linspace(-0.5, 0.5, 41))[1]).max() for one in (sure, unsure)
    ]
    assert fastest[0] > READOUT_TIME * 0.5 * 2.0 * np.pi * 60.0 * np.radians(0.3)
    assert fastest[1] < 0.05 * fastest[0]
    assert sure.swing.sum() < (0.01 * swing) ** 2
    assert unsure.swing.sum() == pytest.approx(swing**2, rel=0.3)


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
