# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates at other times, against differences of their poses and of estimates nearby."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from rs_localizer.core.reasons import Reason
from rs_localizer.core.types import Failure

from ..moving import estimate_at  # noqa: TID252 - Python has a package "test"
from ..pipeline.motions import disturbed  # noqa: TID252

SPAN = 0.03
TAU = np.linspace(-0.8, 0.8, 33)
RATES = 0.2 * np.column_stack([np.sin(4.0 * TAU), np.cos(3.0 * TAU), 0.4 + TAU])


def turned(vector):
    return Rotation.from_rotvec(vector).as_matrix()


def some_estimate(shaken=0, speed=0.2, acceleration=0.3):
    rng = np.random.default_rng(3)
    half = 1e-3 * rng.normal(size=(18 + 3 * shaken, 18 + 3 * shaken))
    half[18:] *= 0.1  # vibration makes ten times as much of the angular velocity
    shake = 0.01 * rng.normal(size=(shaken, 3))
    motion = rsl.Motion(
        turned(rng.normal(size=3)), np.array([0.1, -0.2, 3.0]), *(speed * rng.normal(size=(2, 3))),
        angular_acceleration=acceleration * rng.normal(size=3),
        linear_acceleration=acceleration * rng.normal(size=3),
    )  # fmt: skip
    return estimate_at(
        motion, inliers=np.array([True, False, True]), residuals=np.array([3.0, np.nan, 4.0]),
        joint_covariance=half @ half.T, shake=shake, span=SPAN, time_ns=10**12,
    )  # fmt: skip


def centre(pose):
    return -pose[0].T @ pose[1]


@pytest.mark.parametrize("shaken", [0, 4])
def test_velocities_are_the_derivatives_of_the_poses(shaken):
    estimate, h = some_estimate(shaken), 1e-5
    for tau in (-0.4, 0.0, 0.3):
        before, now, after = (estimate.at(tau + step) for step in (-h, 0.0, h))
        velocity = now[0] @ (centre(after) - centre(before)) / (2.0 * h)
        np.testing.assert_allclose(estimate.linear_velocity_at(tau), velocity, atol=1e-7)
        rate = Rotation.from_matrix(before[0] @ after[0].T).as_rotvec() / (2.0 * h)
        np.testing.assert_allclose(estimate.angular_velocity_at(tau), rate, atol=1e-6)
        later = estimate.at_time(SPAN * tau)
        np.testing.assert_allclose(later.rotation, now[0], atol=1e-12)
        np.testing.assert_allclose(later.position, centre(now), atol=1e-12)
        np.testing.assert_allclose(later.angular_velocity, rate, atol=1e-6)
        np.testing.assert_allclose(later.linear_velocity, velocity, atol=1e-7)
        assert later.time_ns == estimate.time_ns + round(1e9 * SPAN * tau)
    rows = np.array([-0.5, 0.1, 0.5])
    for pose, tau in zip(zip(*estimate.at_rows(rows), strict=True), rows, strict=True):
        np.testing.assert_allclose(pose[0], estimate.at(tau)[0], atol=1e-12)
        np.testing.assert_allclose(pose[1], estimate.at(tau)[1], atol=1e-12)
    with pytest.raises(ValueError, match=r"row times of shape \(n,\), got \(1, 3\)"):
        estimate.at_rows(rows[None])
    with pytest.raises(ValueError, match=r"row times.* got one of 479"):
        estimate.at_rows(np.arange(480))


def apart(one, other):
    """Turn and way in the first one's axes, and differences of the velocities (12,)."""
    return np.concatenate([
        Rotation.from_matrix(one.rotation @ other.rotation.T).as_rotvec(),
        one.rotation @ (other.position - one.position),
        other.angular_velocity - one.angular_velocity,
        other.linear_velocity - one.linear_velocity,
    ])  # fmt: skip


@pytest.mark.parametrize("shaken", [0, 4])
@pytest.mark.parametrize("tau", [-0.45, 0.2, 0.5])
def test_the_covariance_of_then_is_that_of_estimates_nearby(shaken, tau):
    """To first order in motion times vibration or acceleration: here 60 (400 without
    vibration) deg/s, 600 deg/s^2.
    """
    speed = 0.03 if shaken else 0.2
    estimate, h = some_estimate(shaken, speed=speed, acceleration=0.01), 1e-6
    size = len(estimate.joint_covariance)
    columns = []
    for step in h * np.eye(size):
        moved = [disturbed(estimate, sign * step).at_time(SPAN * tau) for sign in (-1.0, 1.0)]
        columns.append(apart(*moved) / (2.0 * h))
    jacobian = np.array(columns).T
    expected = jacobian @ estimate.joint_covariance @ jacobian.T
    found = estimate.at_time(SPAN * tau).covariance
    sizes = np.sqrt(np.diagonal(expected))
    assert np.abs((found - expected) / np.outer(sizes, sizes)).max() < 0.03


def test_beyond_the_rows_vibration_goes_on_in_an_unknown_phase():
    calm, shaken = some_estimate(), some_estimate(4)
    for seconds in (0.03, 0.1):
        assert np.all(calm.at_time(seconds).angular_velocity == calm.angular_velocity_at(
            seconds / SPAN))  # fmt: skip
        grown = [
            np.trace(one.at_time(seconds).covariance[:3, :3]) - np.trace(one.covariance[:3, :3])
            for one in (calm, shaken)
        ]
        assert grown[1] > grown[0]


def test_what_a_result_says_of_itself():
    found = some_estimate()
    assert found
    assert found.residual_rms == math.sqrt(0.5 * (9.0 + 16.0))
    assert "2 of 3 inliers" in repr(found)
    deviation = math.sqrt(np.linalg.eigvalsh(found.joint_covariance[:3, :3])[-1])
    assert found.orientation_deviation == pytest.approx(deviation)
    for tau in (240.0, -0.6, np.nan, "x", None, np.array([0.0, 0.1])):
        with pytest.raises(ValueError, match=r"tau must lie between -0\.5, the first row"):
            found.at(tau)
    with pytest.raises(ValueError, match=r"2e\+07 s from the middle row is too far"):
        found.at_time(2e7)
    with pytest.raises(ValueError, match="seconds must be a finite number, got '0'"):
        found.at_time("0")
    for wrong in (np.timedelta64(1, "ms"), 10**400):
        with pytest.raises(ValueError, match="must be"):
            found.at_time(wrong)
    assert found.at_time(np.array(0.01)).span == found.span
    with pytest.raises(ValueError, match="the readout time is unknown"):
        replace(found, span=0.0).at_time(0.01)
    nothing = Failure(Reason.DEGENERATE, "a line")
    assert not nothing
    assert str(nothing) == "degenerate: a line"
    with pytest.raises(AttributeError, match=r"no rotation, because there is no pose .*if"):
        _ = nothing.rotation


def test_a_covariance_of_others_is_one_beside_arcs_that_the_old_one_was_tied_to():
    """Poses before a plane, tracked, were published with variances below zero."""
    estimate = some_estimate()
    own = estimate.joint_covariance[:12, :12]
    half = np.linalg.cholesky(own)
    tied = np.diag([-0.9, *np.zeros(10), 2.0])
    beside = half @ tied @ half.T
    arched = replace(estimate, undetected_covariance=beside)
    assert np.linalg.eigvalsh(arched.covariance).min() > 0.0
    better = 0.01 * estimate.joint_covariance
    naive = replace(arched, joint_covariance=better)
    assert np.linalg.eigvalsh(naive.covariance).min() < 0.0
    found = arched.with_joint_covariance(better, time_ns=5)
    assert found.time_ns == 5
    widened = found.covariance - better[:12, :12]
    assert np.linalg.eigvalsh(widened).min() > -1e-15
    assert np.linalg.eigvalsh(found.covariance - naive.covariance).min() > -1e-15
    sure = replace(estimate, undetected_covariance=0.5 * own).with_joint_covariance(better)
    np.testing.assert_allclose(sure.undetected_covariance, 0.5 * own, atol=1e-18)


@pytest.mark.parametrize("tau", [0.0, -0.5, 0.3])
def test_the_state_in_si_units_and_in_the_map_is_that_of_the_poses(tau):
    rng = np.random.default_rng(0)
    turn, *vectors = rng.normal(size=(4, 3))
    motion = rsl.Motion(
        Rotation.from_rotvec(turn).as_matrix(), *vectors[:2], 0.1 * vectors[2],
        angular_acceleration=np.array([0.3, -0.2, 0.1]),
    )  # fmt: skip
    camera = rsl.Camera(640, 480, [500, 0, 319.5, 0, 500, 239.5, 0, 0, 1], readout_time=0.02)
    state, step = rsl.camera_state(motion, camera, tau), 1e-6
    places, turns = [], []
    for each in (tau - step, tau, tau + step):
        rotation, translation = motion.at(each)
        places.append(-rotation.T @ translation)
        turns.append(Rotation.from_matrix(rotation.T))
    seconds = 2.0 * step * camera.readout_time
    np.testing.assert_allclose(state.position, places[1], atol=1e-12)
    np.testing.assert_allclose(state.rotation, turns[1].as_matrix(), atol=1e-12)
    np.testing.assert_allclose(Rotation.from_quat(state.orientation).as_matrix(), state.rotation)
    velocity = (places[2] - places[0]) / seconds
    np.testing.assert_allclose(
        state.rotation @ state.linear_velocity, velocity, rtol=1e-5, atol=1e-6
    )
    np.testing.assert_allclose(state.linear_velocity, state.rotation.T @ velocity, rtol=1e-5)
    rate = (turns[2] * turns[0].inv()).as_rotvec() / seconds
    np.testing.assert_allclose(state.rotation @ state.angular_velocity, rate, rtol=1e-5, atol=1e-5)
