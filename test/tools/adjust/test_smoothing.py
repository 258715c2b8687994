# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Smoothing: better than tracking, honest, and silent where the images say nothing."""

import numpy as np
import projector
import pytest

from rs_localizer.core import so3
from rs_localizer.core.rig import Rig
from rs_localizer.core.types import Estimate
from rs_localizer.localizer import Localizer
from rs_localizer.tools.adjust.observe import ImagePoints
from rs_localizer.tools.smoothing import PosedFrame, Smoothed, smooth
from rs_localizer.tracking import Tracker

READOUT = 0.03
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
