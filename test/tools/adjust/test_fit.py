# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The estimator against the independent camera."""

from dataclasses import replace

import numpy as np
import projector
import pytest
from projector import TRUE, make_camera

from rs_localizer.core import so3
from rs_localizer.core.camera import Camera
from rs_localizer.tools.adjust.fit import fit
from rs_localizer.tools.adjust.spline import Spline, first_spline
from rs_localizer.tools.adjust.variables import Freedom, SplineKeypoints, start_state

READOUT = 0.03


def observe(camera: Camera, frames: list[projector.Frame]) -> SplineKeypoints:
    counts = [len(frame.points) for frame in frames]
    points = np.concatenate([frame.points for frame in frames])
    landmarks, rows = np.unique(points, axis=0, return_inverse=True)
    pixels = np.concatenate([frame.pixels for frame in frames])
    return SplineKeypoints(
        camera,
        times=np.repeat([frame.stamp for frame in frames], counts),
        pixels=pixels,
        row_times=camera.row_time(pixels),
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
    rotations, positions = motion.poses(times + 0.5 * READOUT)
    rotations = rotations @ so3.exp_many(rng.normal(0.0, 0.003, (len(times), 3)))
    positions = positions + rng.normal(0.0, 0.01, positions.shape)
    return first_spline(times, rotations, positions, spacing, 0.03)


def test_truth_without_noise():
    rng = np.random.default_rng(3)
    motion, camera = projector.Motion.random(rng, 0.03, 0.02), make_camera()
    frames = projector.record(rng, motion, projector.room(rng), readout=READOUT, seconds=2.0,
                              noise=0.0)  # fmt: skip
    seen = observe(camera, frames)
    start = start_state(seen, guess(rng, motion, frames, 1 / 60), 0.0)
    found = fit(seen, start, Freedom(angular_acceleration=1e4, linear_acceleration=1e4))
    assert found.state.readout_time == pytest.approx(READOUT, abs=2e-6)
    assert np.sqrt(found.squared_errors.max()) < 0.02
    times = np.linspace(0.2, 1.8, 20)
    rotations, positions = motion.poses(times + 0.5 * READOUT)
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
    start = start_state(seen, guess(rng, motion, frames), 0.0)
    found = fit(replace(seen, trusted=half), start, Freedom())
    assert abs(found.state.readout_time - readout) < 4.0 * found.readout_time_deviation < 2e-4
    assert found.deviation == pytest.approx(0.3, rel=0.06)
    assert np.mean(found.inliers == seen.trusted) > 0.99
    times = np.linspace(0.2, 1.8, 40)
    _, positions = motion.poses(times + 0.5 * abs(readout))
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
    start = start_state(seen, guess(rng, motion, believed), 0.0)
    found = fit(seen, start, Freedom(lens=True, landmarks=2e-3))
    assert abs(found.state.readout_time - READOUT) < 4.0 * found.readout_time_deviation < 4e-4
    assert found.camera.K[0, 0] == pytest.approx(TRUE.focal, rel=3e-3)
    assert found.deviation == pytest.approx(0.1, rel=0.1)
