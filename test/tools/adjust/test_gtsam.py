# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The adjustment against GTSAM: what nobody here has written."""

import numpy as np
import projector
import pytest
from dense import fitting
from test_fit import make_camera

from rs_localizer.core import so3
from rs_localizer.tools.adjust.problem import Problem
from rs_localizer.tools.adjust.spline import Layout, Spline
from rs_localizer.tools.adjust.system import Factored
from rs_localizer.tools.adjust.variables import CameraView, Freedom, SplineKeypoints, start_state

gtsam = pytest.importorskip("gtsam")
gtsam_unstable = pytest.importorskip("gtsam_unstable")
NOISE, HELD = 0.5, 0.05  # px, m
POSE, POINT = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L


def observed(camera, times, points, frames) -> SplineKeypoints:
    """Pixels are set later."""
    pixels = np.random.default_rng(1).uniform(0.0, 400.0, (len(frames), 2))
    return SplineKeypoints(
        times=times[frames], row_times=camera.row_time(pixels), pixels=pixels,
        landmarks=points, points=np.tile(np.arange(len(points)), len(times)), frames=frames,
        trusted=np.ones(len(frames), bool),
    )  # fmt: skip


def test_deviations_of_landmarks_are_those_of_its_bundle_adjustment():
    """Global shutters, so that each image has one pose; landmarks are known to 5 cm."""
    rng, camera, times = np.random.default_rng(0), make_camera(), np.arange(5.0)
    motion, points = projector.Motion.random(rng), projector.room(rng, 12)
    layout = Layout.over(np.column_stack([times - 0.02, times + 0.02]), 0.04)
    spline = Spline(layout, *motion.pose(layout.control_times()))
    seen = observed(camera, times, points, np.repeat(np.arange(5), 12))
    free = Freedom(readout_time=False, angular_velocity=2.0, linear_velocity=1.0)
    state = start_state(camera, seen, spline)
    problem = Problem([CameraView(camera, seen, free)], state, deviations=np.full(12, HELD))
    problem = fitting(problem, state)
    found, _ = Factored(problem.system(state, NOISE)).block_covariances()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    K, D = camera.K, camera.D
    lens = gtsam.Cal3DS2(K[0, 0], K[1, 1], 0.0, K[0, 2], K[1, 2], *D[:4])
    poses = spline.states(times)
    for g in range(5):
        pose = gtsam.Pose3(gtsam.Rot3(poses.rotations[g]), poses.positions[g])
        values.insert(POSE(g), pose)
    for p, point in enumerate(points):
        values.insert(POINT(p), point)
        held = gtsam.noiseModel.Isotropic.Sigma(3, HELD)
        graph.add(gtsam.PriorFactorPoint3(POINT(p), point, held))
    noise, ours = gtsam.noiseModel.Isotropic.Sigma(2, NOISE), problem.views[0].observations
    for pixel, g, p in zip(ours.pixels, ours.frames.tolist(), ours.points.tolist(), strict=True):
        graph.add(gtsam.GenericProjectionFactorCal3DS2(pixel, noise, POSE(g), POINT(p), lens))
    assert graph.error(values) < 1e-12
    marginals = gtsam.Marginals(graph, values)
    expected = [marginals.marginalCovariance(POINT(p)) for p in range(12)]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * HELD**2)


def test_errors_are_those_of_its_rolling_shutter_factor():
    """It interpolates two poses: of a camera that turns evenly, the spline does the same."""
    readout, camera = 0.03, make_camera(readout_time=0.03)
    camera = type(camera)(width=640, height=480, K=projector.K, readout_time=readout)
    points, rate = projector.room(np.random.default_rng(0), 30), np.array([0.8, -0.5, 0.3])
    layout = Layout.over(np.array([[-0.05, 0.05]]), 0.02)
    turns = so3.exp_many(layout.control_times()[:, None] * rate)
    place = np.array([0.1, -0.2, 0.05])
    spline = Spline(layout, turns, np.tile(place, (len(turns), 1)))
    seen = observed(camera, np.zeros(1), points, np.zeros(30, int))
    state = start_state(camera, seen, spline, readout)
    errors = Problem([CameraView(camera, seen, Freedom())], state).sights(state)[0].errors
    K, noise = camera.K, gtsam.noiseModel.Unit.Create(2)
    lens = gtsam.Cal3_S2(K[0, 0], K[1, 1], 0.0, K[0, 2], K[1, 2])
    values = gtsam.Values()
    for k, time in enumerate((-0.5 * readout, 0.5 * readout)):
        values.insert(POSE(k), gtsam.Pose3(gtsam.Rot3(so3.exp(time * rate)), place))
    for p, point in enumerate(points):
        values.insert(POINT(p), point)
        factor = gtsam_unstable.ProjectionFactorRollingShutter(
            seen.pixels[p], seen.row_times[p] + 0.5, noise, POSE(0), POSE(1), POINT(p), lens
        )
        np.testing.assert_allclose(errors[p], factor.unwhitenedError(values), atol=1e-8)
