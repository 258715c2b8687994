# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.core.shutter import Motion
from rs_localizer.estimation.prior import (
    Prior,
    add_prior,
    motion_terms,
    state_in,
    with_measurements,
    with_motion,
)
from rs_localizer.estimation.robust import apply_step

from .frames import differences

CENTRE = np.array([10.0, -3.0, 2.0])


def motion():
    rng = np.random.default_rng(0)
    pose = so3.exp(rng.normal(size=3)), *rng.normal(size=(3, 3))
    angular, linear = rng.normal(size=(2, 3))
    return Motion(*pose, angular_acceleration=angular, linear_acceleration=linear)


def covariance(size=18):
    factor = np.random.default_rng(1).normal(size=(size, size))
    return factor @ factor.T / size + 0.1 * np.eye(size)


def evaluate(terms, state, weight=1.0):
    information, slope = np.zeros((18, 18)), np.zeros(18)
    return add_prior(terms, state, weight, information, slope), information, slope


NOTHING = motion_terms((0.0, 0.0), (0.0, 0.0))
PRIORS = {
    "zero": motion_terms((0.2, 0.1), (0.05, 0.03)),
    "motion": with_motion(NOTHING, Prior(motion=motion(), covariance=covariance()), CENTRE),
    "motion but for accelerations": with_motion(
        NOTHING, Prior(motion=motion(), covariance=covariance(size=12)), CENTRE
    ),
    "gyroscope": with_measurements(
        NOTHING, Prior(angular_velocity=[0.1, 0.2, 0.3], angular_velocity_deviation=0.01)
    ),
    "gravity": with_measurements(NOTHING, Prior(gravity=[1.0, 2.0, 0.5], gravity_deviation=0.05)),
}


@pytest.mark.parametrize("name", PRIORS)
def test_the_slope_is_the_finite_difference_of_the_cost(name):
    state = apply_step(state_in(motion(), CENTRE), 0.2 * np.random.default_rng(2).normal(size=18))
    _, _, slope = evaluate(PRIORS[name], state, 3.0)
    found = differences(
        lambda step: evaluate(PRIORS[name], apply_step(state, step), 3.0)[0], 18, 1e-6
    )
    np.testing.assert_allclose(found, 2 * slope, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", PRIORS)
def test_the_information_is_the_curvature_at_the_minimum(name):
    state = state_in(motion(), CENTRE)
    if name == "gravity":  # a rotation that sees gravity where it was measured
        turn, _ = Rotation.align_vectors([[1.0, 2.0, 0.5]], [[0.0, 0.0, -1.0]])
        state[:9] = turn.as_matrix().ravel()
    elif not name.startswith("motion"):
        state[12:] = PRIORS[name].references[-1][12:]
    cost, information, slope = evaluate(PRIORS[name], state)
    assert cost == pytest.approx(0.0, abs=1e-20)
    np.testing.assert_allclose(slope, 0.0, atol=1e-10)
    bent = [evaluate(PRIORS[name], apply_step(state, e))[0] / 1e-8 for e in 1e-4 * np.eye(18)]
    np.testing.assert_allclose(bent, np.diag(information), rtol=1e-4, atol=1e-4)


def pivot(spread):
    """The point about which a camera turns that moves as it turns, as far as it can."""
    root = np.linalg.cholesky(spread)[:6]
    moved = np.concatenate([np.cross(np.eye(3), turn).T for turn in root[:3].T])  # p x turn
    return np.linalg.lstsq(moved, root[3:].T.ravel(), rcond=None)[0]


@pytest.mark.parametrize("size", [12, 18])
def test_a_motion_prior_costs_the_mahalanobis_distance_about_its_pivot(size):
    mean, spread = motion(), covariance(size=size)
    terms = with_motion(NOTHING, Prior(motion=mean, covariance=spread), CENTRE)
    np.testing.assert_allclose(terms.pivots[-1], pivot(spread), rtol=1e-6)
    # Of (12,12) the accelerations are free.
    step = 0.5 * np.random.default_rng(3).normal(size=18)
    cost, _, _ = evaluate(terms, apply_step(state_in(mean, CENTRE), step))
    place, turn = pivot(spread), step[:3]
    step[3:6] = place + np.cross(place, turn) - so3.exp(-turn) @ (place - step[3:6])
    step = step[:size]
    assert cost == pytest.approx(step @ np.linalg.solve(spread, step), rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"motion": motion()}, "a prior motion and its covariance go together"),
        ({"motion": motion(), "covariance": np.eye(6)},
         r"must be \(12,12\) or \(18,18\), got \(6, 6\)"),
        ({"motion": motion(), "covariance": np.zeros((12, 12))}, "must be positive definite"),
        ({"motion": replace(motion(), rotation=2 * np.eye(3)), "covariance": np.eye(12)},
         "rotation is not orthonormal"),
        ({"gravity": [0, 0, 1], "gravity_deviation": 30}, r"and 1\.57 rad, got 30"),
        ({"gravity": [0, 0, 0], "gravity_deviation": 1}, "gravity has no direction"),
    ],
)  # fmt: skip
def test_an_impossible_prior_is_refused_with_what_was_found(arguments, said):
    with pytest.raises(ValueError, match=said):
        Prior(**arguments)
