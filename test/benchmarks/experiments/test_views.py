"""Errors in sigmas against independent truth, and the scenes that they are measured on."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.experiments import bound, tracking
from benchmarks.experiments.results import Verdict
from benchmarks.experiments.robustness_cases import Case, camera_of, view_of
from benchmarks.experiments.trials import Setting, draw_trials
from benchmarks.experiments.views import (
    NO_POSE,
    Outcome,
    View,
    outcome,
    synthetic_views,
)
from rs_localizer.core.reasons import Reason
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.core.types import Estimate, Failure
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


def estimate(motion: Motion, covariance: np.ndarray) -> Estimate:
    fields = {field.name: getattr(motion, field.name) for field in dataclasses.fields(Motion)}
    nothing, joint = np.zeros(0), np.eye(18)
    joint[:12, :12] = covariance
    return Estimate(**fields, inliers=nothing > 0, residuals=nothing, joint_covariance=joint,
                    global_shutter_inliers=0, iterations=0)  # fmt: skip


def view() -> View:
    return next(synthetic_views(1, 5, MOVING, outliers=0.4))


def test_views_are_seen_at_their_own_row() -> None:
    one = view()
    pixels, _ = project_rolling(one.camera, one.motion.at_rows, one.points)
    np.testing.assert_allclose(one.true_pixels, pixels, atol=1e-6)
    off = (one.pixels - one.true_pixels)[one.inliers]
    assert 0.7 < off.std() < 1.3
    assert np.count_nonzero(~one.inliers) == 20
    assert np.abs(one.pixels - one.true_pixels)[~one.inliers].max() > 100.0


def test_the_bound_is_that_of_finite_differences() -> None:
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


def test_noise_lowers_the_information() -> None:
    one = view()
    twice = dataclasses.replace(one, noise=2.0)
    np.testing.assert_allclose(4.0 * twice.information(), one.information())


def test_errors_are_steps_from_the_estimate_to_the_truth() -> None:
    one = view()
    step = 1e-3 * np.arange(1.0, 13.0)
    covariance = np.diag(np.arange(1.0, 13.0)) * 1e-6
    # Taken from where it leads to, the opposite step leads back, to first order.
    found = outcome(one, estimate(moved(one.motion, -step), covariance))
    assert found.reported == pytest.approx(np.sum(step**2 / np.diag(covariance)), rel=0.02)
    assert found.reported_pose + found.reported_velocities == pytest.approx(found.reported)
    assert found.bound == pytest.approx(step @ one.information() @ step, rel=0.02)
    assert found.gross


def test_the_truth_is_no_step_away_and_a_failure_infinitely_far() -> None:
    one = view()
    found = outcome(one, estimate(one.motion, np.eye(12)))
    assert found.bound < 1e-12
    assert found.correct
    lost = outcome(one, Failure(Reason.DEGENERATE, ""))
    assert lost == NO_POSE
    assert not any((lost.localized, lost.correct, lost.gross))


@pytest.mark.parametrize("tilt", [0.0, 30.0])
def test_planes_have_their_tilt(tilt: float) -> None:
    trials = draw_trials(20, 0, Setting(angular=5.0, tilt=tilt))
    for points, rotation in zip(trials.points, trials.truth.rotation, strict=True):
        _, sizes, axes = np.linalg.svd(points)
        assert sizes[2] < 1e-12 * sizes[0]
        angle = np.degrees(np.arccos(min(1.0, abs(axes[2] @ rotation[2]))))
        assert angle == pytest.approx(tilt, abs=1e-5)


def found(bounds: np.ndarray, reported: np.ndarray, at_most: float = 1.05) -> bound.Found:
    case = dataclasses.replace(bound._CASES[0], at_most=at_most)
    return bound.Found(
        case, [Outcome(b, b, r, r, r) for b, r in zip(bounds, reported, strict=True)]
    )


def test_at_the_bound_and_calibrated_or_not() -> None:
    draws = chi2.rvs(12, size=4000, random_state=0)
    right = found(draws, draws)
    assert right.ratio.value == pytest.approx(1.0, abs=0.02)
    assert right.coverage.value == pytest.approx(0.95, abs=0.01)
    assert {claim.verdict for claim in bound.claims(right)} == {Verdict.HELD}
    worse = found(1.2 * draws, 1.2 * draws)  # by a tenth in standard deviations
    verdicts = {claim.name: claim.verdict for claim in bound.claims(worse)}
    assert verdicts["bound.fast"] is Verdict.NOT_HELD
    assert verdicts["bound.fast_calibrated"] is Verdict.NOT_HELD
    modest = found(draws, 0.8 * draws)
    assert modest.coverage.value > 0.97
    assert bound.claims(modest)[1].verdict is Verdict.NOT_HELD


def test_gross_errors_and_those_that_hide() -> None:
    draws = chi2.rvs(12, size=100, random_state=0)
    with_two = np.concatenate([draws, [200.0, 200.0]])
    one = found(with_two, np.concatenate([draws, [200.0, 12.0]]))
    assert one.gross == pytest.approx(2 / 102)
    assert one.overconfident == 1
    assert bound.claims(one)[2].verdict is Verdict.UNDECIDED
    many = found(np.repeat(with_two, 20), np.repeat(with_two, 20))
    assert bound.claims(many)[2].verdict is Verdict.NOT_HELD
    missing = bound.Found(one.case, [*one.outcomes[:90], *[NO_POSE] * 10])
    assert bound.claims(missing)[2].verdict is Verdict.NOT_HELD


@pytest.mark.parametrize(
    ("case", "bad"),
    [
        (Case("a", "", uniform=0.3), 0.3),
        (Case("a", "", second=0.3, uniform=0.2), 0.5),
        (Case("a", "", shifted=0.3), 0.3),
        (Case("a", "", offset=5e6), 0.0),
    ],
)
def test_the_scenes_of_robustness(case: Case, bad: float) -> None:
    one = view_of(case, camera_of(45.0), np.random.default_rng(0))
    assert np.mean(~one.inliers) == pytest.approx(bad)
    # About the points: far from the origin the projection is not exact enough to settle.
    centre = one.points.mean(axis=0)
    near = dataclasses.replace(
        one.motion, translation=one.motion.translation + one.motion.rotation @ centre
    )
    seen, _ = project_rolling(one.camera, near.at_rows, one.points - centre)
    off = np.linalg.norm(seen - one.pixels, axis=1)
    assert np.sqrt(np.mean(off[one.inliers] ** 2) / 2.0) == pytest.approx(1.0, abs=0.15)
    if bad:
        assert np.nanmedian(off[~one.inliers]) > 20.0
    assert np.linalg.norm(one.points.mean(axis=0)) > 0.99 * case.offset


def test_the_second_object_is_rigid_too() -> None:
    case = Case("a", "", second=0.3)
    one = view_of(case, camera_of(45.0), np.random.default_rng(0))
    flipped = dataclasses.replace(one, inliers=~one.inliers)
    from rs_localizer.localizer import Localizer

    other = Localizer(one.camera).localize(one.points[flipped.inliers], one.pixels[flipped.inliers])
    assert other
    assert other.inliers.mean() > 0.9
    assert np.linalg.norm(one.off(other)[3:6]) > 0.3


def test_ratios_of_tracking_are_by_quartile() -> None:
    errors = np.column_stack([np.arange(9.0), np.arange(9.0)])
    one = tracking.Run(np.arange(9.0), errors * [0.5, 2.0], errors, np.arange(9) > 4)
    assert [one.ratio(0.5, column).value for column in (0, 1)] == [0.5, 2.0]
    assert one.share == 0.5
    assert tracking._never_worse(tracking._CASES[2], one).verdict is Verdict.NOT_HELD
    assert tracking._improves(tracking._CASES[0], one).verdict is Verdict.NOT_HELD
    better = dataclasses.replace(one, tracked=0.5 * errors)
    assert tracking._never_worse(tracking._CASES[2], better).verdict is Verdict.HELD
    assert tracking._improves(tracking._CASES[0], better).verdict is Verdict.HELD
