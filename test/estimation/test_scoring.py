# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np

from rs_localizer.core.shutter import Motion
from rs_localizer.estimation.prior import motion_terms
from rs_localizer.estimation.ransac import best_models, optimize, state_of_model
from rs_localizer.estimation.residuals import truncated_cost

FREE = motion_terms((0.0, 0.0), (0.0, 0.0))


def test_models_become_states_by_the_motion_model(scene):
    model = np.random.default_rng(0).normal(size=18)
    rotation, c, w, drift = model[:9].reshape(3, 3), model[9:12], model[12:15], model[15:18]
    motion = Motion(rotation, c, -w, np.cross(w, c) - drift)
    np.testing.assert_allclose(state_of_model(model), scene.state_of(motion), atol=1e-15)


def models_near(motion, count, rng):
    """Models (2,18,count) of model A, worse and worse, in shuffled order; some are NaN."""
    w = -motion.angular_velocity
    true = np.concatenate(
        [
            motion.rotation.ravel(), motion.translation, w,
            np.cross(w, motion.translation) - motion.linear_velocity,
        ]
    )  # fmt: skip
    size = rng.permutation(2 * count) * 1e-4
    models = true[:, None] + size * rng.normal(size=(18, 1))
    models[:, ::5] = np.nan
    return np.ascontiguousarray(models.reshape(18, 2, count).transpose(1, 0, 2)), models


def test_the_best_models_are_those_of_a_full_sort(scene):
    camera, motion, points, _, measured = scene.frame(noise=1.0, count=50)
    data = scene.pack(camera, points, measured)
    models, flat = models_near(motion, 40, np.random.default_rng(1))
    states, costs = best_models(models, data, 8.0, 4, np.inf)
    alive = [state_of_model(column) for column in flat.T if np.isfinite(column).all()]
    expected = sorted(truncated_cost(data, s, 8.0, np.inf) for s in alive)[:4]
    np.testing.assert_allclose(costs, expected, rtol=1e-12)
    for state, cost in zip(states, costs, strict=True):
        assert truncated_cost(data, state, 8.0, np.inf) == cost


def test_places_without_a_model_stay_infinite(scene):
    camera, _, points, _, measured = scene.frame()
    data = scene.pack(camera, points, measured)
    nothing = np.full((1, 18, 3), np.nan)
    states, costs = best_models(nothing, data, 8.0, 2, np.inf)
    assert np.isinf(costs).all()
    _, cost = optimize(states, costs, data, 16.0, 2.0, FREE, 1.0)
    assert np.isinf(cost)


def test_optimisation_reaches_all_inliers_from_a_poor_state(scene):
    camera, motion, points, _, measured = scene.frame(noise=0.5, count=80, seed=3)
    rng = np.random.default_rng(2)
    outliers = np.arange(80) < 32
    measured[outliers] = rng.uniform([0, 0], [639, 479], (32, 2))
    data = scene.pack(camera, points, measured)
    start = scene.state_of(motion)
    start[9:18] += 0.02 * rng.normal(size=9)
    before = truncated_cost(data, start, 2.0, np.inf)
    state, cost = optimize(start[None], np.zeros(1), data, 32.0, 2.0, FREE, 1.0)
    truth = truncated_cost(data, scene.state_of(motion), 2.0, np.inf)
    assert cost == truncated_cost(data, state, 2.0, np.inf)
    assert cost <= truth < before
