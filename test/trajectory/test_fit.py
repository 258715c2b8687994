# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The estimator: its normal equations against differences, its results against an own projector."""

from dataclasses import replace

import numpy as np
import projector
import pytest

from rs_localizer.core import so3
from rs_localizer.core.camera import Camera
from rs_localizer.trajectory.banded import Factored
from rs_localizer.trajectory.fit import fit
from rs_localizer.trajectory.model import Freedom, Observations, State, start_state
from rs_localizer.trajectory.normal_kernels import Normal
from rs_localizer.trajectory.problem import Problem
from rs_localizer.trajectory.spline import Layout, Spline, first_spline

READOUT = 0.03


def make_camera(**changes: object) -> Camera:
    return Camera(width=projector.WIDTH, height=projector.HEIGHT, K=projector.K, D=projector.D,
                  **changes)  # fmt: skip


def observe(camera: Camera, frames: list[projector.Frame]) -> Observations:
    counts = [len(frame.points) for frame in frames]
    points = np.concatenate([frame.points for frame in frames])
    landmarks, rows = np.unique(points, axis=0, return_inverse=True)
    pixels = np.concatenate([frame.pixels for frame in frames])
    return Observations(
        times=np.repeat([frame.stamp for frame in frames], counts),
        row_times=camera.row_time(pixels),
        pixels=pixels,
        landmarks=landmarks,
        points=rows.ravel(),
        frames=np.repeat(np.arange(len(frames)), counts),
        trusted=np.concatenate([frame.good for frame in frames]),
    )


def guess(
    rng: np.random.Generator, motion: projector.Motion, frames: list[projector.Frame],
    spacing: float = 1 / 30,
) -> Spline:  # fmt: skip
    """A spline through poses that are some mm and tenths of a degree off."""
    times = np.array([frame.stamp for frame in frames])
    rotations, positions = motion.pose(times + 0.5 * READOUT)
    rotations = rotations @ so3.exp_many(rng.normal(0.0, 0.003, (len(times), 3)))
    positions = positions + rng.normal(0.0, 0.01, positions.shape)
    return first_spline(times, rotations, positions, spacing, 0.03)


def small_problem(
    rng: np.random.Generator, direction: str = "top_to_bottom", distortion: str = "plumb_bob"
) -> tuple[Problem, State]:
    """Everything free, and errors of zero."""
    camera = make_camera(scan_direction=direction)
    if distortion == "equidistant":
        camera = replace(camera, D=np.array([0.01, -0.02, 0.003, 0.001]),
                         distortion_model=distortion)  # fmt: skip
    motion, landmarks = projector.Motion.random(rng), projector.room(rng, 6)
    layout = Layout.over(np.array([[0.0, 0.1]]), 0.04)
    spline = Spline(layout, *motion.pose(layout.control_times()))
    count = 40
    pixels = rng.uniform(0.0, 400.0, (count, 2))
    seen = Observations(
        times=rng.choice([0.02, 0.05, 0.08], count),
        row_times=camera.row_time(pixels),
        pixels=pixels,
        landmarks=landmarks,
        points=rng.integers(0, 6, count),
        frames=np.zeros(count, int),
        trusted=np.ones(count, bool),
    )
    state = start_state(camera, seen, spline, READOUT)
    # Weak: its errors are not zero, and second derivatives would count.
    freedom = Freedom(True, True, (0.3, 1.0), 0.01, 0.0, 1e4, 1e4)
    _, parts = Problem(camera, seen, state, freedom).look(state)
    exact = replace(seen, pixels=pixels + np.concatenate([part.errors for part in parts]))
    return Problem(camera, exact, state, freedom), state


def as_dense(normal: Normal) -> np.ndarray:
    """The whole symmetric matrix of normal equations."""
    controls, border = normal.cross.shape
    dense = np.zeros((controls + border, controls + border))
    for d in range(len(normal.band)):
        k = np.arange(controls - d)
        dense[k + d, k] = normal.band[d, : controls - d]
    dense[controls:, :controls] = normal.cross.T
    dense[controls:, controls:] = normal.corner
    return np.tril(dense) + np.tril(dense, -1).T


@pytest.mark.parametrize("direction", ["top_to_bottom", "right_to_left"])
@pytest.mark.parametrize("distortion", ["plumb_bob", "equidistant"])
def test_the_normal_matrix_is_the_derivative_of_the_slope(direction, distortion):
    problem, state = small_problem(np.random.default_rng(0), direction, distortion)
    _, normal = problem.normal(state, 1.0)
    controls, border = len(normal.slope), problem.border
    dense = as_dense(normal)
    for k in range(controls + border):
        h = 1e-6 / np.sqrt(dense[k, k] + 1e-12) * 30.0
        slopes = []
        for sign in (-1.0, 1.0):
            step = np.zeros(controls + border)
            step[k] = sign * h
            moved = problem.moved(state, normal, (step[:controls], step[controls:]))
            found = problem.normal(moved, 1.0)[1]
            slopes.append(np.concatenate([found.slope, found.border_slope]))
        numeric = (slopes[1] - slopes[0]) / (2.0 * h)
        scale = np.sqrt(dense[k, k] * np.diag(dense))
        np.testing.assert_allclose(numeric / scale, dense[k] / scale, atol=2e-4)


def test_steps_and_covariances_are_those_of_the_dense_system():
    problem, state = small_problem(np.random.default_rng(1))
    _, normal = problem.normal(state, 1.0)
    normal.slope[:] = np.random.default_rng(2).normal(size=len(normal.slope))
    controls, dense = len(normal.slope), as_dense(normal)
    inverse = np.linalg.inv(dense)
    factored = Factored(normal)
    inner, border = factored.step()
    expected = -inverse @ np.concatenate([normal.slope, normal.border_slope])
    np.testing.assert_allclose(np.concatenate([inner, border]), expected, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(
        factored.border_covariance(), inverse[controls:, controls:], rtol=1e-5, atol=1e-9
    )
    first = np.arange(controls // 6 - 3)
    for k, covariance in zip(first, factored.local_covariances(first), strict=True):
        at = slice(6 * k, 6 * k + 24)
        np.testing.assert_allclose(covariance, inverse[at, at], rtol=1e-5, atol=1e-9)


def test_truth_without_noise():
    rng = np.random.default_rng(3)
    motion, camera = projector.Motion.random(rng, 0.03, 0.02), make_camera()
    frames = projector.record(rng, motion, projector.room(rng), readout=READOUT, seconds=2.0,
                              noise=0.0)  # fmt: skip
    seen = observe(camera, frames)
    start = start_state(camera, seen, guess(rng, motion, frames, 1 / 60))
    found = fit(camera, seen, start, Freedom(angular_acceleration=1e4, linear_acceleration=1e4))
    assert found.state.readout_time == pytest.approx(READOUT, abs=2e-6)
    assert np.sqrt(found.squared_errors.max()) < 0.02
    times = np.linspace(0.2, 1.8, 20)
    rotations, positions = motion.pose(times + 0.5 * READOUT)
    states = found.state.spline.states(times)
    np.testing.assert_allclose(states.positions, positions, atol=2e-4)
    np.testing.assert_allclose(states.rotations, rotations, atol=2e-4)


def test_noise_outliers_and_columns_that_are_read_backwards():
    rng, readout = np.random.default_rng(4), -0.02
    motion, camera = projector.Motion.random(rng), make_camera(scan_direction="left_to_right")
    frames = projector.record(rng, motion, projector.room(rng), readout=readout, seconds=2.0,
                              outliers=0.3, axis=0)  # fmt: skip
    seen = observe(camera, frames)
    # Half of the outliers pass for inliers of their frame.
    half = seen.trusted | (rng.random(len(seen.trusted)) < 0.1)
    start = start_state(camera, seen, guess(rng, motion, frames))
    found = fit(camera, replace(seen, trusted=half), start, Freedom())
    assert abs(found.state.readout_time - readout) < 4.0 * found.readout_time_deviation < 2e-4
    assert found.deviation == pytest.approx(0.3, rel=0.06)
    assert np.mean(found.inliers == seen.trusted) > 0.99
    times = np.linspace(0.2, 1.8, 40)
    _, positions = motion.pose(times + 0.5 * abs(readout))
    angular, linear = motion.twist(times + 0.5 * abs(readout))
    states, covariances = found.state.spline.states(times), found.state_covariances(times)
    for errors, at in (
        (states.positions - positions, slice(3, 6)),
        (np.hstack([states.angular - angular, states.linear - linear]), slice(6, 12)),
    ):
        inverse = np.linalg.inv(covariances[:, at, at])
        squared = np.einsum("ni,nij,nj->n", errors, inverse, errors) / errors.shape[1]
        assert 0.5 < squared.mean() < 2.0


def test_a_wrong_lens_and_a_bent_board_are_found():
    rng = np.random.default_rng(5)
    motion, flat = projector.Motion.random(rng, 0.2, 0.12), projector.board(6, 5, 0.16)
    bent = flat + np.column_stack([np.zeros((len(flat), 2)), 4e-3 * np.sin(5.0 * flat[:, 0])])
    frames = projector.record(rng, motion, bent, readout=READOUT, seconds=4.0, noise=0.1)
    camera = make_camera()
    wrong = replace(camera, K=camera.K * [[1.02], [1.02], [1.0]], D=0.5 * camera.D)
    believed = [replace(f, points=flat[[np.flatnonzero((bent == p).all(axis=1))[0]
                for p in f.points]]) for f in frames if len(f.points) >= 12]  # fmt: skip
    seen = observe(wrong, believed)
    start = start_state(wrong, seen, guess(rng, motion, believed))
    found = fit(wrong, seen, start, Freedom(lens=True, landmarks=2e-3))
    assert abs(found.state.readout_time - READOUT) < 4.0 * found.readout_time_deviation < 4e-4
    assert found.camera.K[0, 0] == pytest.approx(projector.FOCAL, rel=3e-3)
    assert found.deviation == pytest.approx(0.1, rel=0.1)
