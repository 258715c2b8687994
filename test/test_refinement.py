# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What ``refinement`` leaves out: samples that are drawn here, and SciPy, say the same."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from rs_localizer.core.shutter import project_rolling
from rs_localizer.solvers.minimal import solve_minimal

from .moving import pinhole

THRESHOLD, SIZE = 2.0, np.array([640, 480])
CAMERA = pinhole()


def shown(x, points):
    """Pixels (n,2) of points by a motion (12,): rotation vector, C, omega, v."""
    motion = rsl.Motion(Rotation.from_rotvec(x[:3]).as_matrix(), *x[3:].reshape(3, 3))
    return project_rolling(CAMERA, motion.at_rows, points)[0]


def cost_of(x, points, pixels):
    """Sum of the squared errors, truncated at the threshold, and these errors (n,)."""
    errors = np.nan_to_num(np.linalg.norm(shown(x, points) - pixels, axis=1), nan=np.inf)
    return np.sum(np.minimum(errors, THRESHOLD) ** 2), errors


def frame(seed, noise=0.5, wrong=0.3, count=61):
    """Points, pixels and the true motion of a camera that turns by 10 degrees in a readout."""
    rng = np.random.default_rng(seed)
    true = np.concatenate([
        rng.uniform(-0.1, 0.1, 3), [0.0, 0.0, 3.0],
        np.radians(10.0) * rng.normal(size=3) / np.sqrt(3.0), 0.05 * rng.normal(size=3),
    ])  # fmt: skip
    points = rng.uniform([-1.2, -0.9, -1.0], [1.2, 0.9, 1.0], (3 * count, 3))
    pixels = shown(true, points)
    inside = np.flatnonzero(CAMERA.inside(pixels))[:count]
    points, pixels = points[inside], pixels[inside] + noise * rng.normal(size=(count, 2))
    bad = rng.random(count) < wrong
    pixels[bad] = rng.uniform([0, 0], SIZE - 1, (bad.sum(), 2))
    return points, pixels, true


def motion_of(found):
    """Rotation vector, C, omega and v (12,)."""
    turn = Rotation.from_matrix(found.rotation).as_rotvec()
    return np.r_[turn, found.translation, found.angular_velocity, found.linear_velocity]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("solver", ["r6p_vcwt", "r6p_vct_wt"])
def test_none_is_the_best_sample_and_what_fits_it(solver, seed):
    """Better than all of a hundred samples that are drawn here, whose start is the truth."""
    points, pixels, true = frame(seed)
    found = rsl.Localizer(CAMERA, refinement="none", solver=solver, seed=seed).localize(
        points, pixels
    )
    least, errors = cost_of(motion_of(found), points, pixels)
    np.testing.assert_array_equal(found.inliers, errors < THRESHOLD)
    assert np.isnan(found.covariance).all()
    assert np.isnan(found.orientation_deviation)
    rng, start = np.random.default_rng(seed), Rotation.from_rotvec(true[:3]).as_matrix()
    some = np.array([rng.choice(len(points), 6, replace=False) for _ in range(100)])
    rays, tau = CAMERA.rays(pixels), CAMERA.row_time(pixels)
    models = solve_minimal(solver, points[some], rays[some], tau[some], start)
    rotations, c, w, t = (each[:, 0] for each in models)
    turns = Rotation.from_matrix(rotations).as_rotvec()
    others = np.hstack([turns, c, -w, np.cross(w, c) - t])
    assert least < 1.1 * min(cost_of(other, points, pixels)[0] for other in others)


def test_each_solver_is_seen_only_where_nothing_follows_it():
    points, pixels, _ = frame(7, wrong=0.2)
    turns = {
        kind: np.array([
            rsl.Localizer(CAMERA, refinement=kind, solver=solver).localize(points, pixels).rotation
            for solver in ("r6p", "r6p_vct_w", "r6p_vcwt", "joint")
        ])
        for kind in ("none", "motion", "full")
    }  # fmt: skip
    assert np.abs(turns["none"] - turns["none"][:1]).max() > 1e-3
    for kind in ("motion", "full"):
        assert np.abs(turns[kind] - turns[kind][:1]).max() < 1e-4
    still = rsl.Localizer(CAMERA, refinement="none", solver="p3p", min_inliers=7)
    assert not still.localize(*frame(7, wrong=0.2)[:2]).angular_velocity.any()


@pytest.mark.parametrize("seed", range(3))
def test_motion_is_least_squares_of_its_inliers_without_a_prior(seed):
    points, pixels, true = frame(seed)

    found = rsl.Localizer(CAMERA, refinement="motion").localize(points, pixels)
    held = rsl.VelocityPrior(angular=0.01, linear=0.01)
    same = rsl.Localizer(CAMERA, refinement="motion", velocity_prior=held).localize(points, pixels)
    np.testing.assert_array_equal(found.rotation, same.rotation)
    kept, seen = points[found.inliers], pixels[found.inliers]
    best = least_squares(lambda x: (shown(x, kept) - seen).ravel(), true, x_scale=0.01)
    np.testing.assert_allclose(motion_of(found)[:3], best.x[:3], atol=2e-5)
    np.testing.assert_allclose(found.linear_velocity, best.x[9:], atol=2e-4)
    np.testing.assert_allclose(found.angular_acceleration, 0.0, atol=1e-12)
    noise = 2.0 * best.cost / (len(best.fun) - 12)
    covariance = noise * np.linalg.inv(best.jac.T @ best.jac)
    deviations = np.sqrt(np.diag(found.joint_covariance)[6:12])
    np.testing.assert_allclose(deviations, np.sqrt(np.diag(covariance)[6:12]), rtol=0.25)


@pytest.mark.parametrize("kind", ["none", "motion"])
def test_what_is_not_used_is_refused(kind):
    points, pixels, _ = frame(0)
    localizer = rsl.Localizer(CAMERA, refinement=kind)
    with pytest.raises(ValueError, match=f"refinement {kind} knows the points alone"):
        localizer.localize(points, pixels, prior=rsl.Prior(of_rest=1.0))
    with pytest.raises(ValueError, match=f"needs refinement full, got {kind}"):
        rsl.Tracker(localizer)


def test_too_few_inliers_are_no_pose():
    rng = np.random.default_rng(0)
    points, pixels = rng.uniform(-1, 1, (40, 3)), rng.uniform([0, 0], SIZE - 1, (40, 2))
    found = rsl.Localizer(CAMERA, refinement="none", min_inliers=12).localize(points, pixels)
    assert found.reason in ("too_few_inliers", "behind_camera")  # as the samples happen to be
