# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What ``refinement`` leaves out: by a RANSAC of its own over the same seeds, and by SciPy."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from rs_localizer.solvers.minimal import solve_minimal

FOCAL, SIZE, READOUT, THRESHOLD = 500.0, np.array([640, 480]), 0.03, 2.0
CENTRE = 0.5 * (SIZE - 1.0)
CAMERA = rsl.Camera(
    *SIZE.tolist(), K=np.array([[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1.0]]),
    readout_time=READOUT,
)  # fmt: skip
BITS = 2**64 - 1


def row_time(pixels):
    return (pixels[..., 1] - CENTRE[1]) / (SIZE[1] - 1)


def shown(motions, points):
    """Where (m,n,2) motions (m,12: rotation vector, C, omega, v) show points (n,3), by their rows.

    NaN behind the camera, and where no row comes to see a point.
    """
    turns = Rotation.from_rotvec(motions[:, :3]).as_matrix()
    middle = np.einsum("mij,nj->mni", turns, points) + motions[:, None, 3:6]
    tau = np.zeros(middle.shape[:2])
    for _ in range(40):
        local = middle - tau[..., None] * motions[:, None, 9:]
        turned = Rotation.from_rotvec((-tau[..., None] * motions[:, None, 6:9]).reshape(-1, 3))
        local = turned.apply(local.reshape(-1, 3)).reshape(local.shape)
        with np.errstate(all="ignore"):
            pixels = FOCAL * local[..., :2] / local[..., 2:] + CENTRE
        new = np.nan_to_num(np.clip(row_time(pixels), -3.0, 3.0))
        moved, tau = np.abs(new - tau), new
    pixels[(local[..., 2] <= 0.0) | (moved > 1e-6)] = np.nan
    return pixels


def frame(seed, noise=0.5, wrong=0.3, count=61):
    """Points, pixels and the true motion of a camera that turns by 10 degrees in a readout."""
    rng = np.random.default_rng(seed)
    true = np.concatenate([
        rng.uniform(-0.1, 0.1, 3), [0.0, 0.0, 3.0],
        np.radians(10.0) * rng.normal(size=3) / np.sqrt(3.0), 0.05 * rng.normal(size=3),
    ])  # fmt: skip
    points = rng.uniform([-1.2, -0.9, -1.0], [1.2, 0.9, 1.0], (3 * count, 3))
    pixels = shown(true[None], points)[0]
    inside = np.flatnonzero(((pixels > 0.0) & (pixels < SIZE - 1)).all(axis=1))[:count]
    points, pixels = points[inside], pixels[inside] + noise * rng.normal(size=(count, 2))
    bad = rng.random(count) < wrong
    pixels[bad] = rng.uniform([0, 0], SIZE - 1, (bad.sum(), 2))
    return points, pixels, true


class Draws:
    """SplitMix64, and samples of distinct points that lie on rows apart."""

    def __init__(self, seed):
        self.state = seed

    def below(self, count):
        self.state = (self.state + 0x9E3779B97F4A7C15) & BITS
        z = self.state
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & BITS
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & BITS
        return (((z ^ (z >> 31)) >> 32) * count) >> 32

    def sample(self, pool, size, tau):
        for _ in range(8):
            chosen = []
            while len(chosen) < size:
                point = pool[self.below(len(pool))]
                if point not in chosen:
                    chosen.append(point)
            if np.ptp(tau[chosen]) >= 0.25 * np.ptp(tau):
                break
        return chosen


def ransac(solver, size, draws, pools, block, most, points, pixels, scale, start):
    """The motion (12,) whose errors, truncated at ``scale`` px, are least, and how many samples."""
    tau, rays = row_time(pixels), (pixels - CENTRE) / FOCAL
    best, least, drawn = None, np.inf, 0
    while drawn < most:
        count = min(block, most - drawn)
        ends = [(k + 1) * count // len(pools) for k in range(len(pools))]
        places = [np.searchsorted(ends, k, side="right") for k in range(count)]
        samples = np.array([draws.sample(pools[k], size, tau) for k in places])
        rotations, c, w, t = solve_minimal(
            solver, points[samples], rays[samples], tau[samples], start
        )
        there = np.isfinite(c).all(axis=2)
        turns = Rotation.from_matrix(rotations[there]).as_rotvec()
        found = np.hstack([turns, c[there], -w[there], np.cross(w[there], c[there]) - t[there]])
        errors = np.linalg.norm(shown(found, points) - pixels, axis=2)
        costs = np.fmin(errors**2, scale**2)
        costs = np.where(np.isnan(errors), scale**2, costs).sum(axis=1)
        drawn += count
        if costs.min() < least:
            k = int(np.argmin(costs))
            best, least, inliers = found[k], costs[k], errors[k] < scale
        parts = [np.count_nonzero(inliers[pool]) / len(pool) for pool in pools]
        missed = [(1.0 - share**size) ** (drawn / len(pools)) for share in parts]
        if np.prod(missed) < 1.0 - 0.99:
            break
    return best, drawn


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("solver", ["r6p_vcwt", "r6p_vct_wt"])
def test_none_is_the_sample_that_a_loop_of_its_own_finds(solver, seed):
    points, pixels, _ = frame(seed)
    points = points - np.median(points, axis=0)  # as the estimator has them
    draws, everything = Draws(seed), np.arange(len(points))
    wide = 0.05 * FOCAL
    start, _ = ransac("p3p", 3, draws, [everything], 48, 256, points, pixels, wide, np.eye(3))
    errors = np.linalg.norm(shown(start[None], points)[0] - pixels, axis=1)
    pools = [np.flatnonzero(errors < 0.12 * FOCAL), everything]
    turn = Rotation.from_rotvec(start[:3]).as_matrix()
    own, drawn = ransac(solver, 6, draws, pools, 64, 256, points, pixels, THRESHOLD, turn)
    found = rsl.Localizer(
        CAMERA, refinement="none", solver=solver, seed=seed, max_iterations=256
    ).localize(points, pixels)
    assert found.iterations == drawn
    np.testing.assert_allclose(Rotation.from_matrix(found.rotation).as_rotvec(), own[:3], atol=1e-8)
    np.testing.assert_allclose(found.translation, own[3:6], atol=1e-8)
    np.testing.assert_allclose(found.angular_velocity, own[6:9], atol=1e-8)
    np.testing.assert_allclose(found.linear_velocity, own[9:], atol=1e-8)
    errors = np.linalg.norm(shown(own[None], points)[0] - pixels, axis=1)
    np.testing.assert_array_equal(found.inliers, errors < THRESHOLD)
    assert np.isnan(found.covariance).all()
    assert np.isnan(found.orientation_deviation)


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
    best = least_squares(lambda x: (shown(x[None], kept)[0] - seen).ravel(), true, x_scale=0.01)
    np.testing.assert_allclose(
        Rotation.from_matrix(found.rotation).as_rotvec(), best.x[:3], atol=2e-5
    )
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
