# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import fields, replace

import numpy as np
import pytest

from rs_localizer.core import so3
from rs_localizer.core.shutter import Motion
from rs_localizer.estimation.prior import (
    Prior,
    add_prior,
    held_terms,
    motion_terms,
    pivot_of,
    state_in,
    terms_at,
    with_measurements,
    with_motion,
)
from rs_localizer.estimation.refine import apply_step

CENTRE = np.array([10.0, -3.0, 2.0])


def motion(seed=0):
    rng = np.random.default_rng(seed)
    pose = so3.exp(rng.normal(size=3)), *rng.normal(size=(3, 3))
    angular, linear = rng.normal(size=(2, 3))
    return Motion(*pose, angular_acceleration=angular, linear_acceleration=linear)


def covariance(seed=1, size=18):
    factor = np.random.default_rng(seed).normal(size=(size, size))
    return factor @ factor.T / size + 0.1 * np.eye(size)


def evaluate(terms, state, weight=1.0, size=18):
    information, slope = np.zeros((size, size)), np.zeros(size)
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
    h = 1e-6
    for k, e in enumerate(np.eye(18)):
        ahead, behind = (
            evaluate(PRIORS[name], apply_step(state, sign * h * e), 3.0)[0] for sign in (1, -1)
        )
        assert (ahead - behind) / (2 * h) == pytest.approx(2 * slope[k], rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("name", PRIORS)
def test_the_information_is_the_curvature_at_the_minimum(name):
    state = state_in(motion(), CENTRE)
    if name == "gravity":  # a rotation that sees gravity where it was measured
        seen = np.array([1.0, 2.0, 0.5]) / np.linalg.norm([1.0, 2.0, 0.5])
        axis = np.cross([0, 0, -1.0], seen)
        angle = np.arccos(-seen[2])
        state[:9] = so3.exp(angle * axis / np.linalg.norm(axis)).ravel()
    elif not name.startswith("motion"):
        state[12:] = PRIORS[name].references[-1][12:]
    cost, information, slope = evaluate(PRIORS[name], state)
    assert cost == pytest.approx(0.0, abs=1e-20)
    np.testing.assert_allclose(slope, 0.0, atol=1e-10)
    h = 1e-4
    for k, e in enumerate(np.eye(18)):
        bent = evaluate(PRIORS[name], apply_step(state, h * e))[0] / h**2
        assert bent == pytest.approx(information[k, k], rel=1e-4, abs=1e-4)


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


def test_the_pivot_is_what_an_image_sees_and_the_camera_where_its_place_is_measured():
    turn, seen, place = np.diag([0.2, 0.1, 0.05]), np.diag([0.01, 0.01, 0.05]), [0.3, -0.2, 3.0]
    hat = np.cross(place, np.eye(3)).T  # place x turn
    spread = np.zeros((18, 18))
    by = np.block([[np.eye(3), np.zeros((3, 3))], [hat, -np.eye(3)]])
    spread[:6, :6] = by @ np.diag(np.r_[np.diag(turn), np.diag(seen)] ** 2) @ by.T
    np.testing.assert_allclose(pivot_of(spread), place, rtol=1e-6)
    np.testing.assert_allclose(pivot_of(np.eye(18)), 0.0, atol=1e-12)
    assert not np.any(pivot_of(np.diag(np.full(18, np.inf))))


def test_infinite_variances_leave_parameters_free():
    spread = np.diag(np.concatenate([np.full(6, np.inf), np.full(6, 0.01)]))
    terms = with_motion(NOTHING, Prior(motion=motion(), covariance=spread), CENTRE)
    _, information, _ = evaluate(terms, state_in(motion(5), CENTRE))
    np.testing.assert_allclose(information, np.diag([0.0] * 6 + [100.0] * 6 + [0.0] * 6))


def test_motion_terms_are_precisions_and_none_for_zero():
    state = state_in(motion(), CENTRE)
    _, information, slope = evaluate(motion_terms((0.2, 0.0), (0.0, 0.05)), state)
    np.testing.assert_allclose(
        information, np.diag([0.0] * 6 + [25.0] * 3 + [0.0] * 6 + [400.0] * 3)
    )
    np.testing.assert_allclose(slope[6:9], 25.0 * state[12:15])
    np.testing.assert_allclose(slope[15:18], 400.0 * state[21:24])
    assert evaluate(NOTHING, state)[0] == 0.0
    assert evaluate(held_terms(), state)[0] > 1e15


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"motion": motion()}, "a prior motion and its covariance go together"),
        ({"motion": motion(), "covariance": np.eye(6)},
         r"must be \(12,12\) or \(18,18\), got \(6, 6\)"),
        ({"motion": motion(), "covariance": np.zeros((12, 12))}, "must be positive definite"),
        ({"motion": motion(), "covariance": np.triu(np.ones((12, 12)))}, "must be symmetric"),
        ({"motion": replace(motion(), rotation=2 * np.eye(3)), "covariance": np.eye(12)},
         "rotation is not orthonormal"),
        ({"angular_velocity": [1, 2]}, "angular_velocity must be three finite numbers"),
        ({"gravity": [0, 0, 0], "gravity_deviation": 1}, "gravity has no direction"),
    ],
)  # fmt: skip
def test_an_impossible_prior_is_refused_with_what_was_found(arguments, said):
    with pytest.raises(ValueError, match=said):
        Prior(**arguments)


@pytest.mark.parametrize("size", [12, 18])
def test_a_motion_of_which_nothing_is_known_adds_and_replaces_nothing(size):
    prior = Prior(motion=motion(), covariance=np.diag(np.full(size, np.inf)))
    typical = motion_terms((0.1, 0.2), (0.3, 0.4))
    for own in (NOTHING, typical):
        terms, state = with_motion(own, prior, CENTRE), state_in(motion(5), CENTRE)
        for found, expected in zip(evaluate(terms, state), evaluate(own, state), strict=True):
            np.testing.assert_array_equal(found, expected)


def test_a_motion_may_be_given_in_lists():
    names = (field.name for field in fields(Motion))
    listed = Motion(**{name: getattr(motion(), name).tolist() for name in names})
    np.testing.assert_array_equal(state_in(listed, CENTRE), state_in(motion(), CENTRE))


@pytest.mark.parametrize("name", PRIORS)
def test_a_search_has_the_first_twelve_of_all_parameters(name):
    """With the accelerations held where they are, at the same cost."""
    state = apply_step(state_in(motion(), CENTRE), 0.2 * np.random.default_rng(2).normal(size=18))
    cost, information, slope = evaluate(PRIORS[name], state, 2.0)
    searched = evaluate(PRIORS[name], state, 2.0, size=12)
    assert searched[0] == cost
    np.testing.assert_array_equal(searched[1], information[:12, :12])
    np.testing.assert_array_equal(searched[2], slope[:12])


def test_a_prior_of_the_accelerations_replaces_that_of_the_configuration():
    own = motion_terms((0.2, 0.1), (0.05, 0.03))
    state = state_in(motion(), CENTRE)
    for size, stays in ((12, True), (18, False)):
        prior = Prior(motion=motion(), covariance=covariance(size=size))
        both = evaluate(with_motion(own, prior, CENTRE), state)[1]
        added = evaluate(with_motion(NOTHING, prior, CENTRE), state)[1]
        left = np.diag(both - added)
        np.testing.assert_allclose(left[6:12], np.repeat([25.0, 100.0], 3), rtol=1e-9)
        assert np.allclose(left[12:], np.repeat([400.0, 1e4 / 9], 3) if stays else 0.0)
    assert evaluate(own, state)[1][17, 17] > 0.0  # the terms themselves are left alone


def test_a_slower_motion_is_a_narrower_prior_and_rest_the_narrowest():
    own = with_measurements(
        motion_terms((0.2, 0.1), (0.05, 0.03)), Prior(gravity=[0, 1, 0], gravity_deviation=0.1)
    )
    precisions = np.diag(own.informations[0])
    # Who hardly turns may walk, at a tenth of the speed; that has all the jolts.
    for part, walk, jolts in ((0.3, 0.3, 1.0), (0.01, 0.1, 0.1)):
        slower = np.diag(terms_at(own, part, False).informations[0])
        np.testing.assert_allclose(slower[6:9], precisions[6:9] / part**2)
        np.testing.assert_allclose(slower[9:12], precisions[9:12] / walk**2)
        np.testing.assert_allclose(slower[12:], precisions[12:] / jolts**2)
    resting = terms_at(own, 0.0, False)
    np.testing.assert_array_equal(resting.gravity, own.gravity)
    assert np.diag(resting.informations[0])[6:].min() > 1e15
