# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The loop with mock solvers: what it draws, when it stops, what it keeps; and with real ones."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer import Localizer
from rs_localizer.estimation import search
from rs_localizer.estimation.prior import motion_terms
from rs_localizer.solvers.table import find_solver

from ..moving import pinhole  # noqa: TID252 - Python has a package "test"
from .frames import changed, frame

FREE = motion_terms((0.0, 0.0), (0.0, 0.0))


class Solver:
    """Gives the true motion for samples of inliers alone, and another one for all others."""

    def __init__(self, model, outliers):
        self.model, self.outliers = model, outliers
        self.samples = []

    def __call__(self, points, rays, tau, samples, rotations, iterations, models):
        self.samples.append(samples.copy())
        good = ~self.outliers[samples].any(axis=1)
        wrong = self.model.copy()
        wrong[9] += 1.0
        models[0] = np.where(good, self.model[:, None], wrong[:, None])


def problem(outlier_share):
    """100 observations, the solver's model of their motion, and which of them are wrong."""
    observations, state = frame(0, 0.1, 0.3, count=100)
    outliers, points = np.arange(100) < outlier_share * 100, observations.points.copy()
    points[outliers] += np.random.default_rng(0).uniform(-2.0, 2.0, (outliers.sum(), 3))
    drift = np.cross(-state[12:15], state[9:12]) - state[15:18]
    model = np.concatenate([state[:12], -state[12:15], drift])
    return changed(observations, points), model, outliers


def run(observations, solver, *pools):
    mock = replace(find_solver("r6p_vcwt"), solve=solver)
    hypotheses = search.Hypotheses(mock, 50, 2000, 8.0, 2.0, 1.0, 5, 0.99)
    alike = [search.Pool.of(points, 1.0, 0) for points in pools]
    observed = SimpleNamespace(observations=observations, random=search.generator(1))
    return search.search(observed, hypotheses, FREE, alike, np.eye(3), search.NOTHING)


EVERYTHING = np.arange(100)


def test_it_finds_the_inliers_and_stops_when_it_is_sure():
    observations, model, outliers = problem(0.5)
    solver = Solver(model, outliers)
    found = run(observations, solver, EVERYTHING)
    inliers = observations.squared_errors(found.state) < 4.0
    assert (inliers == ~outliers).mean() > 0.97
    # log(0.01) / log(1 - 0.5^6) = 293 samples, in blocks of 50.
    assert 250 <= found.samples <= 350
    assert found.samples == sum(map(len, solver.samples))


def test_good_pools_stop_the_search_early_and_all_are_drawn_from():
    observations, model, outliers = problem(0.7)
    solver = Solver(model, outliers)
    found = run(observations, solver, np.flatnonzero(~outliers), EVERYTHING)
    assert found.samples == 50
    (samples,) = solver.samples
    assert not outliers[samples[:25]].any()
    assert outliers[samples[25:]].any()


@pytest.fixture(scope="session")
def samples_of(as_python):
    drawn = as_python(search.draw)

    def samples_of(pool, count, size, tau):
        samples = np.full((count, size), -1)
        camera, random = np.zeros(len(tau), np.int64), search.generator(0)
        drawn(search.Pool.of(pool, 1.0, 0), 0, tau, camera, random, samples)
        return samples

    return samples_of


def test_all_points_are_drawn_equally_often(samples_of):
    pool = np.random.default_rng(0).permutation(1000)[:50]
    counts = np.bincount(
        samples_of(pool, 20000, 6, np.linspace(-0.5, 0.5, 1000)).ravel(), minlength=1000
    )[pool]
    expected = 20000 * 6 / 50
    # Five standard deviations of a count.
    assert np.abs(counts - expected).max() < 5 * np.sqrt(expected)


def test_samples_spread_over_the_rows_where_they_can(samples_of):
    tau = np.concatenate([np.full(90, 0.1), np.linspace(-0.5, 0.5, 10)])
    spread = np.ptp(tau[samples_of(np.arange(100), 1000, 6, tau)], axis=1)
    anywhere = np.array([np.random.default_rng(k).choice(100, 6, False) for k in range(1000)])
    without = np.ptp(tau[anywhere], axis=1)
    assert np.mean(spread < 0.25) < 0.2 * np.mean(without < 0.25)
    # Where all rows are the same, samples come nevertheless.
    assert (samples_of(np.arange(10), 5, 6, np.zeros(10)) >= 0).all()


def test_models_become_states_by_the_motion_model(as_python):
    model = np.random.default_rng(0).normal(size=18)
    c, w, drift = model[9:12], model[12:15], model[15:18]
    expected = np.concatenate([model[:12], -w, np.cross(w, c) - drift, np.zeros(6)])
    found = as_python(search.state_of_model)(model)
    np.testing.assert_allclose(found, expected, atol=1e-15)


CAMERA = pinhole(1200.0, 1000, 1000, readout_time=0.0)
TURN, WAY = np.radians(10.0), 0.1  # per readout


def fast_frame(seed, count=200, outliers=0.0, plane=None):
    """Points and pixels of a camera that turns and moves; at the middle row it is the map.

    Points lie on the rays of pixels, in a plane 0.6 m wide at this distance, or at any depth.
    """
    rng = np.random.default_rng(seed)
    pixels = 499.5 + rng.uniform(-1.0, 1.0, (count, 2)) * (499.5 if plane is None else 180.0)
    tau = pixels[:, 1:] / 999.0 - 0.5
    axis, along = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
    rays = np.column_stack([(pixels - 499.5) / 1200.0, np.ones(count)])
    rays, places = Rotation.from_rotvec(TURN * tau * axis).apply(rays), WAY * tau * along
    depths = rng.uniform(1.0, 4.0, (count, 1))
    if plane is not None:
        depths = (plane - places[:, 2:]) / rays[:, 2:]
    measured = pixels + rng.normal(size=(count, 2))
    wrong = round(outliers * count)
    measured[:wrong] = rng.uniform(0.0, 999.0, (wrong, 2))
    return places + depths * rays, measured


@pytest.mark.parametrize("outliers", [0.0, 0.5, 0.7])
def test_of_an_ordinary_frame_no_more_samples_are_drawn(outliers):
    for seed in range(5):
        default, patient = (
            Localizer(CAMERA, max_iterations=most).localize(*fast_frame(seed, outliers=outliers))
            for most in (1000, 1_000_000)
        )
        assert default.iterations == patient.iterations <= 128
        np.testing.assert_array_equal(default.rotation, patient.rotation)


@pytest.mark.parametrize("frames", [10, pytest.param(40, marks=pytest.mark.bench)])
def test_a_fast_camera_before_a_plane_that_faces_it_is_found(frames):
    """The global-shutter pose, from which the search starts, leans."""
    localizer = Localizer(CAMERA)
    for seed in range(frames):
        estimate = localizer.localize(*fast_frame(seed, 50, plane=2.0))
        assert estimate
        assert estimate.iterations <= 128
        assert Rotation.from_matrix(estimate.rotation).magnitude() < np.radians(6.0)
