"""Estimates and their errors, where the right answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.experiments import methods as m
from benchmarks.experiments.bounds import median_bound
from benchmarks.experiments.convergence import algebraic_errors
from benchmarks.experiments.errors import angles, motion_errors
from benchmarks.experiments.kernels import frame_errors
from benchmarks.experiments.trials import Motions, Setting, draw_trials

STILL = draw_trials(20, 0, Setting())
MOVING = draw_trials(40, 0, Setting(15.0, 0.15, 1.0))


def shifted(truth: Motions) -> Motions:
    """2 degrees, 0.3 in position, 1 degree per frame and 0.05 per frame off."""
    turn = Rotation.from_rotvec([0.0, np.radians(2.0), 0.0]).as_matrix()
    rotation = turn @ truth.rotation
    position = truth.position + np.array([0.0, 0.3, 0.0])
    return Motions(
        rotation,
        -np.einsum("hij,hj->hi", rotation, position),
        truth.w + np.radians([0.6, 0.0, 0.8]),
        truth.t + np.array([0.03, 0.04, 0.0]),
    )


def test_errors_of_known_size() -> None:
    errors = motion_errors(shifted(MOVING.truth), MOVING.truth)
    distance = np.linalg.norm(MOVING.truth.position, axis=1)
    np.testing.assert_allclose(errors[:, 0], 2.0)
    np.testing.assert_allclose(errors[:, 1], 0.3 / distance)
    np.testing.assert_allclose(errors[:, 2], 1.0)
    np.testing.assert_allclose(errors[:, 3], 0.05)


def test_no_estimate_is_an_infinite_error() -> None:
    lost = shifted(MOVING.truth)
    lost.rotation[3] = np.nan
    errors = motion_errors(lost, MOVING.truth)
    assert np.all(np.isinf(errors[3, :2]))
    assert np.all(np.isfinite(np.delete(errors, 3, axis=0)))


def test_angles_near_zero_and_pi() -> None:
    for angle in (0.0, 1e-7, 1.0, 179.9999, 180.0):
        turn = Rotation.from_rotvec([0.0, 0.0, np.radians(angle)]).as_matrix()
        assert angles(turn[None], np.eye(3)[None])[0] == pytest.approx(angle, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("method", m.available(m.ALL), ids=lambda method: method.name)
def test_a_camera_at_rest_without_noise_is_found(method: m.Method) -> None:
    errors = motion_errors(m.estimate(method, STILL), STILL.truth)
    assert np.median(errors[:, 0]) < 1e-6
    assert np.median(errors[:, 1]) < 1e-6


def test_the_states_of_the_truth_explain_every_point() -> None:
    exact = draw_trials(40, 0, Setting(15.0, 0.15))
    arguments = m.view_arguments(exact)
    errors = frame_errors(m.states(exact.truth), *arguments)
    assert errors.max() < 1e-6
    off = frame_errors(m.states(shifted(exact.truth)), *arguments)
    assert off.min() > 1.0


def test_the_best_triplet_is_nearer_than_any_that_fits() -> None:
    best = motion_errors(m.best_triplet(MOVING), MOVING.truth)[:, 0]
    plausible = motion_errors(m.plausible_triplet(MOVING), MOVING.truth)[:, 0]
    assert np.all(best <= plausible + 1e-9)
    assert np.mean(best) < 0.8 * np.mean(plausible)


def test_joint_takes_one_of_its_two_solutions() -> None:
    found = m.estimate(m.JOINT, MOVING)
    one, other = (m.estimate(method, MOVING) for method in (m.VCT_W, m.VCWT_OURS))
    first = np.isclose(found.w, one.w).all(axis=1)
    second = np.isclose(found.w, other.w).all(axis=1)
    assert np.all(first | second)
    assert second.sum() > first.sum() > 0


def test_refinement_uses_all_points() -> None:
    start = motion_errors(m.estimate(m.VCWT_OURS, MOVING), MOVING.truth)
    end = motion_errors(m.estimate(m.REFINED, MOVING), MOVING.truth)
    assert np.all(np.median(end, axis=0) < 0.2 * np.median(start, axis=0))


def test_the_bound_is_reached_and_scales_with_the_noise() -> None:
    trials = draw_trials(400, 1, Setting(15.0, 0.15, 0.5))
    bound = median_bound(trials, 50, 0.5, seed=0)
    refined = np.median(motion_errors(m.estimate(m.REFINED, trials), trials.truth), axis=0)
    np.testing.assert_allclose(refined[:2], bound, rtol=0.15)
    np.testing.assert_allclose(median_bound(trials, 50, 2.0, seed=0), 4.0 * bound)
    assert np.all(median_bound(trials, 6, 0.5, seed=0) > 3.0 * bound)


def test_algebraic_error_is_zero_where_the_equations_hold() -> None:
    trials = draw_trials(30, 2, Setting(15.0, 0.15))
    initial = trials.truth.rotation
    solved = m.estimate(m.Method("", "", "r6p_vcwt", iterations=30), trials)
    errors = algebraic_errors(solved, trials, initial)
    assert np.median(errors) < 1e-12
    # One point off by d in the first coordinate: d / sqrt(12 equations).
    moved = replace(trials, rays=trials.rays.copy())
    moved.rays[:, 2, 0] += 1e-3
    depth = (
        np.einsum("hij,hj->hi", trials.truth.rotation, trials.points[:, 2])[:, 2]
        + trials.truth.translation[:, 2]
    )
    off = algebraic_errors(solved, moved, initial)
    np.testing.assert_allclose(off, 1e-3 * depth / np.sqrt(12.0), rtol=0.2)
    assert np.all(depth > 0.0)
