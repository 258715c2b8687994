# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Points that are left out: mismatches, or witnesses against the motion."""

import numpy as np
import pytest

import rs_localizer as rsl
from benchmarks.gross import frame
from rs_localizer.core.shutter import project_rolling
from rs_localizer.estimation.left_out import as_nearest


def results(scene, fault, count=6):
    random = np.random.default_rng(5)
    for _ in range(count):
        camera, points, pixels, _ = frame(scene, fault, random)
        yield rsl.Localizer(camera).localize(points, pixels)


@pytest.mark.parametrize("scene", ["corner", "markers", "volume"])
def test_right_calibrations_lose_no_frame(scene):
    for fault in ("right", "a tenth wrong"):
        assert all(result and not result.left_out for result in results(scene, fault))


@pytest.mark.parametrize(
    ("scene", "fault"),
    [
        ("corner", "binned twice"), ("markers", "binned twice"), ("volume", "ROI twice"),
        ("wall", "half moved"), ("volume", "half moved"),
    ],
)  # fmt: skip
def test_what_has_two_poses_has_none(scene, fault):
    found = [result for result in results(scene, fault) if result]
    assert found == []


def test_a_moved_corner_is_a_notice():
    camera, points, pixels, rotation = frame("volume", "right", np.random.default_rng(2))
    moved = np.argsort(points[:, 0])[: len(points) // 4]
    points[moved] += (0.0, 0.5, 0.0)
    result = rsl.Localizer(camera).localize(points, pixels)
    assert result
    assert not result.inliers[moved].any()
    assert "left out at the left of the image have a pose of their own" in result.left_out
    assert np.abs(result.rotation - rotation).max() < 0.01


def test_two_fifths_of_the_matches_that_are_shifted_alike_are_left_out():
    random = np.random.default_rng(3)
    for shift in (6.0, 12.0, 25.0):
        camera, points, pixels, rotation = frame("volume", "right", random)
        some = random.permutation(len(points))[: 2 * len(points) // 5]
        pixels[some] += (shift, 0.0)
        result = rsl.Localizer(camera).localize(points, pixels)
        assert result
        assert not result.inliers[some].any()
        assert np.abs(result.rotation - rotation).max() < 0.01


@pytest.mark.parametrize("seed", [11, 16, 21, 27, 48])
def test_no_motion_between_two_groups_is_found(seed):
    """Scored at four thresholds, one that misses either group by half of their distance is."""
    random = np.random.default_rng(seed)
    camera, points, pixels, rotation = frame("volume", "right", random)
    some = random.permutation(len(points))[: 2 * len(points) // 5]
    pixels[some] += (8.0, 0.0)
    result = rsl.Localizer(camera).localize(points, pixels)
    assert result
    assert not result.inliers[some].any()
    assert np.abs(result.rotation - rotation).max() < 0.01


def test_a_fast_camera_may_leave_out_a_few_points_that_lie_near():
    """As a phone in a car, whose matches come from tracks."""
    random = np.random.default_rng(3)
    for speed in (5.0, 15.0):
        velocity = 0.02 * np.array([speed, 0.0, 0.0])
        camera = rsl.Camera(640, 480, [[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]],
                            readout_time=0.02)  # fmt: skip
        points = random.uniform((-9.0, -7.0, 15.0), (9.0, 7.0, 25.0), (300, 3))
        truth = rsl.Motion(np.eye(3), np.zeros(3), np.zeros(3), velocity)
        pixels, _ = project_rolling(camera, truth.at_rows, points)
        seen = camera.inside(pixels)
        points, pixels = points[seen], pixels[seen] + random.normal(0.0, 0.3, (seen.sum(), 2))
        pixels[::15] += random.uniform(-30.0, 30.0, (len(pixels[::15]), 2))
        assert rsl.Localizer(camera).localize(points, pixels)


def test_neighbours_are_alike_by_their_distance():
    random = np.random.default_rng(0)
    places, errors = 300.0 * random.random((50, 2)), 30.0 * random.normal(size=(50, 2))
    apart = np.linalg.norm(places[:, None] - places, axis=2) + np.diag(np.full(50, np.inf))
    nearest = apart.argmin(axis=1)
    off = np.linalg.norm(errors - errors[nearest], axis=1)
    expected = np.count_nonzero(off < 10.0 + 0.5 * apart.min(axis=1))
    assert 0 < expected < 50
    assert as_nearest(places, errors, 10.0) == expected
