# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The loop with mock solvers: what it draws, when it stops, what it keeps."""

import numpy as np
import pytest

from rs_localizer.core.rig import Mounts
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.prior import motion_terms
from rs_localizer.estimation.ransac import (
    NOTHING,
    Candidate,
    Draws,
    Hypotheses,
    Pool,
    generator,
    search,
)

IDENTITY = np.eye(3)
FREE = motion_terms((0.0, 0.0), (0.0, 0.0))
ROWS = 1.0  # range of the row times


class Solver:
    """Gives the true motion for samples of inliers alone, and another one for all others."""

    def __init__(self, model, outliers, always_wrong=False):
        self.model, self.outliers, self.always_wrong = model, outliers, always_wrong
        self.samples, self.rotations = [], []

    def __call__(self, points, rays, tau, samples, rotations, iterations, models):
        self.samples.append(samples.copy())
        self.rotations.append(rotations[0].copy())
        good = ~self.outliers[samples].any(axis=1) & (not self.always_wrong)
        wrong = self.model.copy()
        wrong[9] += 1.0
        models[0] = np.where(good, self.model[:, None], wrong[:, None])


@pytest.fixture
def problem(scene):
    def make(outlier_share, seed=0, count=100):
        camera, motion, points, _, measured = scene.frame(speed=0.1, noise=0.3, count=count)
        outliers = np.arange(count) < outlier_share * count
        rng = np.random.default_rng(seed)
        measured[outliers] = rng.uniform([0, 0], [639, 479], (outliers.sum(), 2))
        rays = camera.rays(measured)
        observations = Observations.of(
            points, rays, camera.row_time(measured), camera.pixel_jacobian(rays),
            Mounts.one(camera.row_time_gradient),
        )  # fmt: skip
        w = -motion.angular_velocity
        drift = np.cross(w, motion.translation) - motion.linear_velocity
        model = np.concatenate([motion.rotation.ravel(), motion.translation, w, drift])
        return observations, model, outliers

    return make


def run(observations, solver, pools, max_samples=2000, confidence=0.99, rotations=(IDENTITY,),
        start=NOTHING, seed=1):  # fmt: skip
    hypotheses = Hypotheses(
        solve=solver, sample_size=6, solutions=1, block=50, score_scale=8.0, final_scale=2.0,
        noise=1.0,
    )  # fmt: skip
    draws = Draws(rotations, pools, confidence, max_samples, generator(seed))
    return search(observations, hypotheses, FREE, draws, start)


def everything(observations):
    return Pool(np.arange(len(observations)), ROWS)


def test_it_finds_the_inliers_and_stops_when_it_is_sure(problem):
    observations, model, outliers = problem(0.5)
    solver = Solver(model, outliers)
    found = run(observations, solver, [everything(observations)])
    inliers = observations.squared_errors(found.state) < 4.0
    assert (inliers == ~outliers).mean() > 0.97
    # log(0.01) / log(1 - 0.5^6) = 293 samples, in blocks of 50.
    assert 250 <= found.samples <= 350
    assert found.samples == sum(map(len, solver.samples))


def test_it_gives_up_after_the_most_samples(problem):
    observations, model, outliers = problem(0.5)
    solver = Solver(model, outliers, always_wrong=True)
    found = run(observations, solver, [everything(observations)], max_samples=120)
    assert found.samples == 120
    assert [len(block) for block in solver.samples] == [50, 50, 20]


def test_without_outliers_one_block_is_enough(problem):
    observations, model, outliers = problem(0.0)
    assert run(observations, Solver(model, outliers), [everything(observations)]).samples == 50


def test_a_better_start_is_kept(problem, scene):
    observations, model, outliers = problem(0.3)
    start = Candidate(np.arange(24.0), 1e-6)
    found = run(observations, Solver(model, outliers), [everything(observations)], start=start)
    assert found.state is start.state


def test_good_pools_stop_the_search_early_and_all_are_drawn_from(problem):
    observations, model, outliers = problem(0.7)
    solver = Solver(model, outliers)
    good = Pool(np.flatnonzero(~outliers), ROWS)
    found = run(observations, solver, [good, everything(observations)])
    assert found.samples == 50
    (samples,) = solver.samples
    assert not outliers[samples[:25]].any()
    assert outliers[samples[25:]].any()


def test_pools_that_are_too_small_are_left_out(problem):
    observations, model, outliers = problem(0.0)
    found = run(
        observations, Solver(model, outliers), [Pool(np.arange(5), ROWS), everything(observations)]
    )
    assert found.found
    nothing = run(observations, Solver(model, outliers), [Pool(np.arange(5), ROWS)])
    assert not nothing.found
    assert nothing.samples == 0


def test_initial_rotations_take_turns(problem):
    observations, model, outliers = problem(0.5)
    solver = Solver(model, outliers, always_wrong=True)
    rotations = [np.eye(3), 2 * np.eye(3), 3 * np.eye(3)]
    run(observations, solver, [everything(observations)], max_samples=300, rotations=rotations)
    assert {rotation[0, 0] for rotation in solver.rotations} == {1.0, 2.0, 3.0}


def test_scores_put_good_samples_first(problem):
    observations, model, outliers = problem(0.7)
    ranked = Pool(np.argsort(outliers, kind="stable"), ROWS, ranked=True)
    solver = Solver(model, outliers)
    run(observations, solver, [ranked], max_samples=1000)
    assert not outliers[solver.samples[0]].any()


def test_it_goes_on_from_where_another_search_stopped(problem):
    """The samples of the first count: towards the most, and towards being sure."""
    observations, model, outliers = problem(0.5)
    pools = [everything(observations)] * 2
    first = run(observations, Solver(model, outliers, always_wrong=True), pools, max_samples=200)
    solver = Solver(model, outliers)
    later = run(observations, solver, pools, max_samples=250, start=first)
    assert later.samples == 250
    assert sum(map(len, solver.samples)) == 50
    # Of 293 samples that it takes to be sure 280 were drawn before, and a block has 50.
    sure = run(observations, Solver(model, outliers), pools)
    before = Candidate(sure.state, sure.cost, 280)
    assert run(observations, solver, pools, start=before).samples == 330
