# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pose, twist and covariances at a moment, against finite differences of the motion model."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.config import Acceleration
from rs_localizer.core.arrays import Array
from rs_localizer.core.shutter import Motion
from rs_localizer.core.types import Estimate
from rs_localizer.pipeline.pose_at_time import pose_at, twist_at, with_timing

from ..moving import estimate_at  # noqa: TID252 - Python has a package "test"
from .motions import covariance_of, disturbed

READOUT_TIME = 0.03
TAUS = [-0.5, 0.0, 0.3, -7.0]
# Per readout: none, nearly none, fast, and around half a turn.
RATES = [0.0, 1e-6, 0.5, 3.0]


# Cosines and sines of the in-frame turn: the faster, the smaller.
SHAKING = 28
SIZES = 1.0 / np.arange(1, 15)[:, None] ** np.array([1.0, 2.0])
SIZES = SIZES.ravel()[:, None]
DEVIATIONS = [0.003, 0.01, 0.02, 0.05, 0.01, 0.02, *0.001 * SIZES[:, 0]]


def estimate(rate: float, seed: int = 0, acceleration: float = 0.0, shake: float = 0.0) -> Estimate:
    rng = np.random.default_rng(seed)
    size = 3 * len(DEVIATIONS)
    root = rng.normal(size=(size, size)) / np.sqrt(size) * np.repeat(DEVIATIONS, 3)[:, None]
    direction = rng.normal(size=3)
    motion = Motion(
        Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3),
        rate * direction / np.linalg.norm(direction), rate * rng.normal(size=3),
        angular_acceleration=acceleration * rng.normal(size=3),
        linear_acceleration=acceleration * rng.normal(size=3),
    )  # fmt: skip
    shaking = shake * SIZES * rng.normal(size=(SHAKING, 3))
    return estimate_at(motion, joint_covariance=root @ root.T, shake=shaking)


def shake(motion: Estimate, tau: float) -> Array:
    """A cosine and a sine per half-cycle of the readout, less value and slope at 0."""
    if abs(tau) > 0.51:  # beyond the rows it stays as it was; differences reach a little beyond
        tau = 0.5 if tau > 0.0 else -0.5
    angles = 0.5 * 2.0 * np.pi * np.arange(1, len(motion.shake) // 2 + 1) * tau
    cosines, sines = np.cos(angles) - 1.0, np.sin(angles) - angles
    return cosines @ motion.shake[::2] + sines @ motion.shake[1::2]


def pose(motion: Estimate, tau: float) -> tuple[Array, Array]:
    angle = tau * motion.angular_velocity + 0.5 * tau**2 * motion.angular_acceleration
    way = tau * motion.linear_velocity + 0.5 * tau**2 * motion.linear_acceleration
    map_from_camera = motion.rotation.T
    turned = Rotation.from_rotvec(angle) * Rotation.from_rotvec(shake(motion, tau))
    centre = map_from_camera @ (way - motion.translation)
    return map_from_camera @ turned.as_matrix(), centre


def pose_error(motion: Estimate, tau: float, error: Array) -> Array:
    rotation, position = pose(motion, tau)
    turned, moved = pose(disturbed(motion, error), tau)
    about_fixed_axes = Rotation.from_matrix(turned @ rotation.T).as_rotvec()
    return np.concatenate([moved - position, about_fixed_axes])


def twist(motion: Estimate, tau: float) -> Array:
    """Linear and angular velocity in body axes, by central differences of the poses."""
    step = 1e-5
    before, after, now = pose(motion, tau - step), pose(motion, tau + step), pose(motion, tau)
    seconds = 2.0 * step * READOUT_TIME
    linear = now[0].T @ (after[1] - before[1]) / seconds
    angular = Rotation.from_matrix(before[0].T @ after[0]).as_rotvec() / seconds
    return np.concatenate([linear, angular])


@pytest.mark.parametrize("tau", TAUS)
@pytest.mark.parametrize("rate", RATES)
def test_pose_and_its_rate_of_change(rate, tau):
    motion = estimate(rate, acceleration=0.2 * rate, shake=0.003)
    rotation, position = pose(motion, tau)
    found, velocities = pose_at(motion, tau), twist_at(motion, tau, READOUT_TIME)
    assert np.allclose(found.rotation, rotation, atol=1e-13)
    assert np.allclose(found.position, position, atol=1e-13)
    expected = twist(motion, tau)
    assert np.allclose([*velocities.linear, *velocities.angular], expected, rtol=1e-6, atol=2e-6)
    motion = estimate(rate)
    joint = motion.joint_covariance
    expected = covariance_of(lambda error: pose_error(motion, tau, error), joint, 1e-5)
    assert np.allclose(pose_at(motion, tau).covariance, expected, rtol=1e-6, atol=1e-9)
    # Far outside the readout there is no shaking.
    joint = joint[:18, :18]
    motion = replace(motion, shake=np.zeros((0, 3)), joint_covariance=joint)
    expected = covariance_of(lambda error: twist(disturbed(motion, error), tau), joint, 1e-4)
    found = twist_at(motion, tau, READOUT_TIME)
    assert np.allclose(found.covariance, expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("tau", [-0.5, 0.2, 0.5])
@pytest.mark.parametrize(("acceleration", "shake"), [(0.01, 0.0), (0.0, 0.001), (0.05, 0.001)])
def test_covariances_of_an_uneven_motion(acceleration, shake, tau):
    """To first order of acceleration (the default deviation is 0.01) and shaking."""
    motion = estimate(0.2, acceleration=acceleration, shake=shake)
    for found, function, step in (
        (pose_at(motion, tau).covariance, lambda error: pose_error(motion, tau, error), 1e-5),
        (twist_at(motion, tau, READOUT_TIME).covariance,
         lambda error: twist(disturbed(motion, error), tau), 1e-4),
    ):  # fmt: skip
        expected = covariance_of(function, motion.joint_covariance, step)
        scale = np.sqrt(np.diag(expected))
        assert np.allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale),
                           atol=0.005)  # fmt: skip


def test_an_uncertain_readout_time_enters_both_covariances():
    motion = estimate(0.5, acceleration=0.1)
    deviation = 0.001
    pose, twist = pose_at(motion, 0.0), twist_at(motion, 0.0, READOUT_TIME)
    later = twist_at(motion, 0.0, READOUT_TIME + 1e-7)
    by_time = np.concatenate([later.linear - twist.linear, later.angular - twist.angular]) / 1e-7
    doubted_pose, doubted_twist = with_timing(
        pose, twist, deviation / READOUT_TIME, 0.5 * deviation, Acceleration(20.0, 5.0)
    )
    # What the camera may do besides in the time that is in doubt.
    changed = (0.5 * deviation * np.repeat([5.0, 20.0], 3)) ** 2
    np.testing.assert_allclose(
        doubted_twist.covariance - twist.covariance,
        deviation**2 * np.outer(by_time, by_time) + np.diag(changed), rtol=1e-4, atol=1e-12,
    )  # fmt: skip
    # The middle row comes half of the doubt later: the camera has moved on by then.
    soon = 1e-5  # readouts
    ahead = pose_at(motion, soon)
    turn = Rotation.from_matrix(ahead.rotation @ pose.rotation.T).as_rotvec()
    way = np.concatenate([ahead.position - pose.position, turn]) / (soon * READOUT_TIME)
    np.testing.assert_allclose(
        doubted_pose.covariance - pose.covariance,
        (0.5 * deviation) ** 2 * (np.outer(way, way) + 0.25 * np.diag(changed)),
        rtol=1e-3, atol=1e-9,
    )  # fmt: skip

    # A camera at rest may have begun to move within the delay.
    rest = replace(estimate(0.0), linear_velocity=np.zeros(3))
    pose, twist = pose_at(rest, 0.0), twist_at(rest, 0.0, READOUT_TIME)
    doubted, _ = with_timing(pose, twist, 0.0, 0.1, Acceleration(20.0, 5.0))
    way = 0.5 * np.repeat([5.0, 20.0], 3) * 0.1**2
    np.testing.assert_allclose(doubted.covariance - pose.covariance, np.diag(way**2), atol=1e-12)


@pytest.mark.parametrize("tau", [-0.67, -2.5, 0.7])
def test_nothing_runs_away_beyond_the_rows(tau):
    # A stamp outside the exposure, as of cameras that stamp its start; shaking of high
    # frequencies.
    rng = np.random.default_rng(0)
    shaking = 0.002 * SIZES * rng.normal(size=(SHAKING, 3))
    seen = replace(estimate(0.1), shake=shaking, joint_covariance=1e-10 * np.eye(18 + 84))
    edge = 0.5 if tau > 0.0 else -0.5
    before, after = pose_at(seen, edge), pose_at(seen, tau)
    turn = Rotation.from_matrix(before.rotation.T @ after.rotation).magnitude()
    assert turn < (0.1 + 0.05) * abs(tau - edge)
    # Beyond the rows nobody knows where the shaking is.
    deviations = [np.sqrt(np.linalg.eigvalsh(p.covariance[3:, 3:])) for p in (before, after)]
    fastest = np.sqrt(np.mean(seen.shake_at(0.45)[1] ** 2))
    assert deviations[1].min() > deviations[0].max()
    assert deviations[1].min() > 0.1 * fastest * abs(tau - edge)
    found = twist_at(seen, tau, READOUT_TIME)
    assert np.abs(found.angular).max() < 0.5 / READOUT_TIME
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0


def test_what_no_row_has_seen_grows_with_the_distance():
    """Shaking goes on at one of its rates."""
    motion = replace(
        estimate(0.0), shake=0.002 * SIZES * np.ones((SHAKING, 3)),
        joint_covariance=np.zeros((102, 102)),
    )  # fmt: skip
    rows = np.linspace(-0.5, 0.5, 17)
    seen = np.mean([motion.shake_at(row)[1] ** 2 for row in rows])
    for tau in (0.7, 0.8, 1.4):
        moved = replace(motion, span=READOUT_TIME).at_time(tau * READOUT_TIME)
        for there, at in ((motion, tau), (moved, 0.0)):
            found = pose_at(there, at).covariance[3:, 3:]
            expected = seen * (tau - 0.5) ** 2 * np.eye(3)
            np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-14)
        assert (moved.covariance.diagonal()[6:9] > 0.5 * seen).all()
