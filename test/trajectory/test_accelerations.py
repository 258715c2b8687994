# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The prior of the accelerations against dense covariances, and what an estimate says of them."""

import numpy as np
import projector
from dense import normal_of
from scipy.linalg import toeplitz
from scipy.spatial.transform import Rotation
from test_fit import guess, make_camera, observe

from rs_localizer.tools.adjust.fit import fit
from rs_localizer.tools.adjust.motion import acceleration_rows
from rs_localizer.tools.adjust.problem import Problem, View
from rs_localizer.tools.adjust.spline import Layout, Spline
from rs_localizer.tools.adjust.variables import Freedom, start_state
from rs_localizer.tools.smoothing import told

SPACING, ANGULAR, LINEAR, FADING = 0.04, 3.0, 2.0, 0.1


def two_stretches() -> Spline:
    """Of seven and of five controls."""
    motion = projector.Motion.random(np.random.default_rng(0))
    layout = Layout.over(np.array([[0.0, 4 * SPACING], [1.0, 1.0 + 2 * SPACING]]), SPACING)
    return Spline(layout, *motion.pose(layout.control_times()))


def by_hand(spline: Spline, fading: float) -> float:
    """Squares of the accelerations at the controls in units of their covariance."""
    cost = 0.0
    for part in (slice(0, 7), slice(7, 12)):
        turns = Rotation.from_matrix(spline.rotations[part])
        steps = (turns[:-1].inv() * turns[1:]).as_rotvec()
        angular = np.diff(steps, axis=0) / SPACING**2
        linear = np.diff(spline.positions[part], 2, axis=0) / SPACING**2
        apart = np.arange(len(linear)) * SPACING
        correlation = np.exp(-apart / fading) if fading else (apart == 0.0).astype(float)
        inverse = np.linalg.inv(toeplitz(correlation))
        cost += np.sum(angular * (inverse @ angular)) / ANGULAR**2
        cost += np.sum(linear * (inverse @ linear)) / LINEAR**2
    return float(cost)


def test_the_prior_is_that_of_accelerations_that_fade():
    spline = two_stretches()
    for fading in (0.0, FADING):
        freedom = Freedom(angular_acceleration=ANGULAR, linear_acceleration=LINEAR, fading=fading)
        rows = acceleration_rows(spline, freedom.accelerations(SPACING))
        np.testing.assert_allclose(rows.cost, by_hand(spline, fading), rtol=1e-9)
        np.testing.assert_allclose(rows.cost, np.sum(rows.errors**2), rtol=1e-12)


def test_the_keypoints_tell_as_many_numbers_as_the_trace_says():
    rng = np.random.default_rng(1)
    motion, camera = projector.Motion.random(rng), make_camera()
    frames = projector.record(rng, motion, projector.room(rng, 60), readout=0.03, seconds=0.6)
    seen = observe(camera, frames)
    start = start_state(camera, seen, guess(rng, motion, frames), 0.03)
    freedom = Freedom(False, angular_acceleration=8.0, linear_acceleration=4.0, fading=FADING)
    found = fit(camera, seen, start, freedom, 0.5)
    problem = Problem([View(camera, seen, freedom)], found.state)
    expected = freedom.accelerations(found.state.spline.layout.spacing)
    prior, _ = normal_of(problem.groups, [acceleration_rows(found.state.spline, expected)])
    whole, _ = normal_of(problem.groups, problem.terms(found.state, found.deviation))
    share = np.linalg.solve(whole, prior)
    parts = np.tile(np.repeat([0, 1], 3), len(found.state.spline.positions))
    count = 3 * (len(found.state.spline.positions) - 2)
    # The prior has no terms between turns and places: the trace falls apart into theirs.
    assert np.all(prior[np.ix_(parts == 0, parts == 1)] == 0.0)
    expected = [count - np.trace(share[np.ix_(parts == k, parts == k)]) for k in (0, 1)]
    np.testing.assert_allclose(told(found).numbers, expected, rtol=1e-4)
