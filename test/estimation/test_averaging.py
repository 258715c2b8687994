# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""One Gaussian of many."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.state import PARAMETERS, step_between
from rs_localizer.estimation.mirror import longest_axis
from rs_localizer.estimation.modes import averaged
from rs_localizer.estimation.refine import apply_step

STATE = np.concatenate([np.eye(3).ravel(), [0.0, 0.0, 2.0], np.zeros(12)])


def gaussians(seed=0, apart=1e-3):
    rng = np.random.default_rng(seed)
    states = np.array([apply_step(STATE, apart * rng.normal(size=PARAMETERS)) for _ in range(3)])
    roots = 1e-3 * rng.normal(size=(3, PARAMETERS, PARAMETERS + 4))
    return states, roots @ np.swapaxes(roots, 1, 2)


def offset(state, other):
    """By how much the camera turns, and the middle of the points (the origin) moves before it."""
    turn, seen = step_between(state, other)[:3], state[9:12]
    step = step_between(state, other)
    step[3:6] = np.cross(seen, turn) - (other[9:12] - seen)
    return step


def test_mean_and_covariance_are_those_of_the_mixture():
    states, covariances = gaussians()
    weights = np.array([0.5, 0.3, 0.2])
    mean, covariance, steps, *_ = averaged(states, covariances, 0, weights, weights)
    expected = np.array([offset(states[0], state) for state in states])
    np.testing.assert_allclose(steps, expected, atol=1e-15)
    centre = weights @ expected
    np.testing.assert_allclose(offset(states[0], mean), centre, atol=1e-15)
    off = expected - centre
    moments = np.einsum("k,ki,kj->ij", weights, off, off) + np.tensordot(weights, covariances, 1)
    scale = np.sqrt(np.diag(moments))
    np.testing.assert_allclose(
        covariance / np.outer(scale, scale), moments / np.outer(scale, scale), atol=0.01
    )


def test_cameras_on_an_arc_about_the_points_are_as_far_away_as_each_of_them():
    """Their mean step would be nearer by 0.13 m, and its covariance deep."""
    states = np.array([apply_step(STATE, np.zeros(PARAMETERS)) for _ in range(2)])
    for state, angle in zip(states, (-0.5, 0.5), strict=True):
        state[:9] = Rotation.from_rotvec([angle, 0.0, 0.0]).as_matrix().ravel()
    weights = np.array([0.5, 0.5])
    mean, covariance, *_ = averaged(states, np.zeros((2, 18, 18)), 0, weights, weights)
    np.testing.assert_allclose(mean, STATE, atol=1e-12)
    # Turns about x move the camera along y, which is all that is open.
    arc = np.zeros(PARAMETERS)
    arc[0], arc[4] = 0.5, -2.0 * 0.5
    np.testing.assert_allclose(np.abs(covariance), np.abs(np.outer(arc, arc)), atol=1e-12)


def test_one_alone_stays_as_it_is():
    states, covariances = gaussians()
    alone = np.array([0.0, 1.0, 0.0])
    mean, covariance, *_ = averaged(states, covariances, 1, alone, alone)
    np.testing.assert_allclose(mean, states[1], atol=1e-15)
    np.testing.assert_allclose(covariance, covariances[1], atol=1e-18)


def test_the_longest_axis_of_the_orientation():
    covariance = np.diag(np.square(np.arange(1.0, 19.0)))
    assert longest_axis(covariance) == pytest.approx(3.0)
