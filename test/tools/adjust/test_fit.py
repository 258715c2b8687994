# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The fit and the smoothing of recordings: near the truth, and honest."""

from dataclasses import replace

import numpy as np
import projector
import pytest
from projector import TRUE, make_camera

from rs_localizer.core import so3
from rs_localizer.core.camera import Camera
from rs_localizer.core.rig import Rig
from rs_localizer.core.types import Estimate
from rs_localizer.localizer import Localizer
from rs_localizer.tools.adjust.fit import fit
from rs_localizer.tools.adjust.observe import ImagePoints
from rs_localizer.tools.adjust.spline import Spline, first_spline
from rs_localizer.tools.adjust.variables import Freedom, SplineKeypoints, start_state
from rs_localizer.tools.smoothing import PosedFrame, Smoothed, smooth
from rs_localizer.tracking import Tracker

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


CAMERA = projector.make_camera(readout_time=READOUT)
Frames = list[tuple[float, ImagePoints, Estimate]]


def track(frames: list[projector.Frame]) -> Frames:
    tracker = Tracker(Localizer(CAMERA))
    found = []
    for frame in frames:
        stamp_ns = round(frame.stamp * 1e9)
        result = tracker.localize(stamp_ns + round(0.5e9 * READOUT), frame.points, frame.pixels)
        if isinstance(result, Estimate):
            keep = result.inliers
            seen = ImagePoints(stamp_ns, frame.points[keep], frame.pixels[keep])
            found.append((frame.stamp + 0.5 * READOUT, seen, result))
    return found


def errors(
    motion: projector.Motion, times: np.ndarray, estimates: list[Estimate]
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (m,12) in the order of the covariance, SI, and the covariances (m,12,12)."""
    rotations, positions = motion.poses(times)
    angular, linear = motion.twist(times)
    scale = np.repeat([1.0, 1.0 / READOUT], 6)
    rows = [
        np.concatenate([
            so3.log(np.ascontiguousarray(rotation.T @ one.rotation.T)),
            rotation.T @ (one.position - position),
            one.angular_velocity / READOUT - rate,
            one.linear_velocity / READOUT - rotation.T @ velocity,
        ])
        for one, rotation, position, rate, velocity in zip(
            estimates, rotations, positions, angular, linear, strict=True)
    ]  # fmt: skip
    return np.array(rows), np.array([scale[:, None] * e.covariance * scale for e in estimates])


def run(frames: Frames) -> Smoothed:
    rig, later = Rig.of(CAMERA), round(0.5e9 * READOUT)
    (name,) = rig.cameras
    posed = [PosedFrame(seen.stamp_ns + later, {name: seen}, one) for _, seen, one in frames]
    return smooth(rig, posed)


@pytest.mark.parametrize("turn", [0.14, pytest.param(0.35, marks=pytest.mark.bench)])
def test_smoothed_motion_is_better_than_tracked_and_its_covariance_holds(turn):
    rng = np.random.default_rng(11)
    motion = projector.Motion.random(rng, turn, 0.08)
    recorded = projector.record(rng, motion, projector.room(rng, 1500), readout=READOUT,
                                seconds=2.5, noise=1.0, outliers=0.2)  # fmt: skip
    frames = track(recorded)
    times = np.array([time for time, _, _ in frames])
    sampled = run(frames).sample(np.round(times * 1e9).astype(np.int64))
    assert np.all(sampled.determined)
    assert not np.any(sampled.bridged)
    tracked, _ = errors(motion, times, [e for _, _, e in frames])
    found, covariances = errors(motion, times, sampled.estimates)
    parts = (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12))
    for at, most in zip(parts, (0.8, 0.8, 0.45, 0.45), strict=True):
        ratio = np.median(np.linalg.norm(found[:, at], axis=1)) / np.median(
            np.linalg.norm(tracked[:, at], axis=1))  # fmt: skip
        assert ratio < most
    for at in (slice(0, 6), slice(6, 12)):
        squared = np.einsum("ni,nij,nj->n", found[:, at], np.linalg.inv(covariances[:, at, at]),
                            found[:, at])  # fmt: skip
        assert np.mean(squared < 12.59) > 0.9
        assert 2.0 < squared.mean() < 8.0


def test_gaps_are_bridged_only_where_the_neighbours_determine_them():
    rng = np.random.default_rng(12)
    motion = projector.Motion.random(rng)
    recorded = projector.record(rng, motion, projector.room(rng), readout=READOUT, seconds=3.2)
    short = [f for f in recorded if not 1.0 < f.stamp < 1.09]
    both = [f for f in short if not 1.8 < f.stamp < 2.6]
    found = run(track(both))
    moments = np.array([0.5, 1.05, 2.2, 3.0])
    sampled = found.sample(np.round(moments * 1e9).astype(np.int64))
    assert sampled.determined.tolist() == [True, True, False, True]
    assert sampled.bridged.tolist() == [False, True, True, False]
    offsets, covariances = errors(motion, moments, sampled.estimates)
    for k in (0, 1, 3):
        squared = offsets[k, :6] @ np.linalg.inv(covariances[k, :6, :6]) @ offsets[k, :6]
        assert squared < 25.0
