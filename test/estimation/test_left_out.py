# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Points that are left out: mismatches, or witnesses against the motion."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from benchmarks.frames import paired_set
from benchmarks.frames.gross import frame
from benchmarks.frames.judged import far_off, judge
from rs_localizer.core.reasons import Reason
from rs_localizer.core.shutter import project_rolling

from ..moving import AT_REST, error_of, pinhole, squared  # noqa: TID252 - Python has a package "test"

FAR_6, FAR_3 = 22.5, 16.3  # 99.9 % of so many degrees of freedom
CENTRE = np.array([319.5, 239.5])


def frames(scene, fault="right", count=6, seed=5):
    """Camera, points, pixels, rotation and more random numbers, so many times."""
    random = np.random.default_rng(seed)
    for _ in range(count):
        yield *frame(scene, fault, random), random


def results(scene, fault):
    for camera, points, pixels, *_ in frames(scene, fault):
        yield rsl.Localizer(camera).localize(points, pixels)


def turned(result, rotation):
    off = error_of(result, replace(AT_REST, rotation=rotation))[:3]
    return squared(off, result.covariance)


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
    assert not any(results(scene, fault))


@pytest.mark.parametrize(("fault", "length"), [("binned twice", 2.0), ("ROI twice", 1.0)])
def test_another_matrix_is_named(fault, length):
    named = 0
    for camera, points, pixels, *_ in frames("markers", fault, 12):
        result = rsl.Localizer(camera).localize(points, pixels)
        assert not result
        pattern = r"length of (\S+) times K's and a principal point (\S+), (\S+) px"
        if words := re.search(pattern, str(result)):
            named += 1
            found, *centre = map(float, words.groups())
            assert found == pytest.approx(length, rel=0.02)
            assert np.abs(camera.K[:2, 2] + centre - CENTRE).max() < 10.0
    assert named >= 2


@pytest.mark.parametrize("share", [2.0, 0.5])
def test_a_k_of_another_size_is_refused_before_one_wall(share):
    """Where focal length and distance go together; the principal point tells the size."""
    named, published = 0, 0
    for camera, points, pixels, *_ in frames("wall", count=12, seed=3):
        assert rsl.Localizer(camera).localize(points, pixels)
        K = camera.K * [[share], [share], [1.0]]
        result = rsl.Localizer(rsl.Camera(640, 480, K, readout_time=0.02)).localize(points, pixels)
        published += bool(result)
        if found := re.search(r"a focal length of (\S+) times K's", str(result)):
            assert float(found[1]) == pytest.approx(1.0 / share, rel=0.1)
            assert result.reason == Reason.CALIBRATION
            named += 1
    assert named >= 2
    assert published <= 1  # a camera that looks at the wall straight on


def test_a_principal_point_that_is_a_little_off_is_no_other_image():
    for camera, points, pixels, rotation, random in frames("volume", "a tenth wrong"):
        pixels[::3] += random.uniform(-20.0, 20.0, (len(pixels[::3]), 2))
        K = camera.K + 6.0 * np.outer([1, 0, 0], [0, 0, 1])
        result = rsl.Localizer(replace(camera, K=K)).localize(points, pixels)
        assert result
        assert np.abs(result.rotation - rotation).max() < 0.02


@pytest.mark.parametrize("bench", ["bodies", "near"])
def test_what_moves_or_is_matched_nearby_is_left_out(bench):
    for _, one in paired_set.spoilt():
        if one.bench == bench:
            found = judge(one, 4, 7, {})
            assert np.count_nonzero(found.localized) >= 3
            assert found.of("deg")[found.localized].max() < 1.5
            assert not far_off(found).any()


@pytest.mark.parametrize("deviation", [0.013, 0.05])  # 3 and 11 px at 2.2 m
def test_noise_beyond_the_gate_is_learnt_and_named(deviation):
    for camera, points, pixels, rotation, random in frames("volume", count=4, seed=4):
        points = points + deviation * random.normal(size=points.shape)
        result = rsl.Localizer(camera).localize(points, pixels)
        if len(points) < 60:
            continue
        assert result
        assert result.inliers.mean() > 0.9
        words = re.search(r"set map_deviation to (\S+) m", result.left_out)
        assert words is not None
        assert float(words[1]) == pytest.approx(deviation, rel=0.3)
        assert turned(result, rotation) < FAR_3


@pytest.mark.parametrize("focal_length", [60.0, 130.0, 260.0])
def test_noise_as_wide_as_rays_of_a_wide_lens_are(focal_length):
    """All points fit, so nothing was chosen: no chance made them fit."""
    rng, localizer = np.random.default_rng(0), rsl.Localizer(pinhole(focal_length))
    for _ in range(3):
        pixels, depth = rng.uniform([0, 0], [639, 479], (100, 2)), rng.uniform(2.0, 4.0, (100, 1))
        points = depth * np.column_stack([(pixels - CENTRE) / focal_length, np.ones(100)])
        result = localizer.localize(points, pixels + rng.normal(0.0, 5.0, pixels.shape))
        assert result, result
        assert squared(error_of(result, AT_REST)[:6], result.covariance) < FAR_6


@pytest.mark.parametrize(
    ("seed", "declared"), [(4, 0.3), (10, 0.3), (11, 0.3), (5, 0.0), (9, 0.0), (12, 0.0)]
)
def test_near_points_of_a_rough_map_do_not_make_the_others_fit_by_chance(seed, declared):
    """A street whose landmarks are off by 0.3 m: 5 m away by 30 px, at 60 m by 3."""
    rng = np.random.default_rng(seed)
    pixels, depth = rng.uniform([0, 0], [639, 479], (100, 2)), rng.uniform(*np.log([5, 200]), 100)
    points = np.exp(depth)[:, None] * np.column_stack([(pixels - CENTRE) / 500.0, np.ones(100)])
    points += rng.normal(0.0, 0.3, points.shape)
    pixels[:30] = rng.uniform(0, [639, 479], (30, 2))  # mismatches
    result = rsl.Localizer(pinhole(), map_deviation=declared).localize(points, pixels)
    assert result, result
    assert squared(error_of(result, AT_REST)[:6], result.covariance) < FAR_6


def test_gates_as_wide_as_a_motion_is_absurd_are_no_error():
    localizer, random = rsl.Localizer(pinhole(), map_deviation=0.3), np.random.default_rng(3)
    wall = np.column_stack([random.uniform(-3.0, 3.0, (400, 2)), np.full(400, 3.0)])
    for _ in range(24):
        matches = wall[random.integers(0, 400, 100)] + 0.3 * random.normal(size=(100, 3))
        assert not localizer.localize(matches, random.uniform(0.0, [639.0, 479.0], (100, 2)))


def test_points_that_fit_by_chance_claim_no_more_than_where_they_are():
    """Some of 18 points that are off by up to 15 px fit a motion: none is published as certain."""
    inside = []
    for camera, points, pixels, rotation, random in frames("volume", count=12, seed=8):
        noisy = pixels[:18] + random.uniform(-15.0, 15.0, (18, 2))
        if result := rsl.Localizer(camera).localize(points[:18], noisy):
            inside.append(turned(result, rotation) < FAR_3)
    assert len(inside) > 1
    assert all(inside)


def test_a_moved_corner_is_a_notice():
    ((camera, points, pixels, rotation, _),) = frames("volume", count=1, seed=2)
    moved = np.argsort(points[:, 0])[: len(points) // 4]
    points[moved] += (0.0, 0.5, 0.0)
    result = rsl.Localizer(camera).localize(points, pixels)
    assert result
    assert not result.inliers[moved].any()
    assert "left out have a pose of their own" in result.left_out
    assert np.abs(result.rotation - rotation).max() < 0.01
    # Or the room was moved, and not the corner: with the share of that, the camera is half a metre
    # away.
    along, share = result.rotation @ (0.0, 1.0, 0.0), len(moved) / len(points)
    deviation = np.sqrt(along @ result.covariance[3:6, 3:6] @ along)
    assert deviation == pytest.approx(0.5 * np.sqrt(share), rel=0.15)


@pytest.mark.parametrize(
    ("shift", "seed"),
    [(6.0, 3), (12.0, 3), (25.0, 3), (8.0, 11), (8.0, 16), (8.0, 21), (8.0, 27), (8.0, 48)],
)
def test_two_fifths_of_the_matches_that_are_shifted_alike_are_left_out(shift, seed):
    """Scored at four thresholds, a motion between both groups is the best one by 8 px."""
    ((camera, points, pixels, rotation, random),) = frames("volume", count=1, seed=seed)
    some = random.permutation(len(points))[: 2 * len(points) // 5]
    pixels[some] += (shift, 0.0)
    result = rsl.Localizer(camera).localize(points, pixels)
    assert result
    assert not result.inliers[some].any()
    assert np.abs(result.rotation - rotation).max() < 0.01


@pytest.mark.parametrize("speed", [5.0, 15.0])
def test_a_fast_camera_may_leave_out_a_few_points_that_lie_near(speed):
    """As a phone in a car, whose matches come from tracks."""
    random, camera = np.random.default_rng(3), pinhole(readout_time=0.02)
    points = random.uniform((-9.0, -7.0, 15.0), (9.0, 7.0, 25.0), (300, 3))
    truth = replace(AT_REST, linear_velocity=0.02 * np.array([speed, 0.0, 0.0]))
    pixels, _ = project_rolling(camera, truth.at_rows, points)
    seen = camera.inside(pixels)
    points, pixels = points[seen], pixels[seen] + random.normal(0.0, 0.3, (seen.sum(), 2))
    pixels[::15] += random.uniform(-30.0, 30.0, (len(pixels[::15]), 2))
    assert rsl.Localizer(camera).localize(points, pixels)


@pytest.mark.parametrize("order", [[1, 2, 3, 0], [2, 3, 0, 1]])
@pytest.mark.parametrize("seed", [5, 6, 7])
def test_corners_of_markers_in_another_order_have_no_pose(order, seed):
    """Nobody says which points are a marker's: four in a row that are a square."""
    said = []
    for camera, points, pixels, *_ in frames("markers", count=8, seed=seed):
        if len(points) == 40:  # all of each marker
            turned = pixels.reshape(-1, 4, 2)[:, order].reshape(-1, 2)
            result = rsl.Localizer(camera).localize(points, turned)
            assert not result
            said.append("come in another order" in result.detail)
    assert sum(said) > len(said) // 2


@pytest.mark.parametrize(("seed", "markers"), [(18, 4), (24, 6), (35, 6)])
def test_a_marker_that_was_moved_does_not_make_the_camera_another_one(seed, markers):
    """Of a wall of markers one was moved by some 10 cm, which other focal lengths explain, too."""
    rng = np.random.default_rng(seed)
    square = 0.1 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]])
    places = np.array([(x, y, 0.0) for x in (-0.8, 0.0, 0.8) for y in (-0.45, 0.45)])[:markers]
    tilt = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3) * [1, 1, 0])
    points = tilt.apply((places[:, None] + square).reshape(-1, 3)) + np.array([0.0, 0.0, 2.2])
    pixels = 500.0 * points[:, :2] / points[:, 2:] + CENTRE
    pixels += rng.normal(0.0, 0.3, pixels.shape)
    points[4:8] += 0.1 * rng.normal(size=3)
    result = rsl.Localizer(pinhole()).localize(points, pixels)
    assert result or result.reason is Reason.UNCERTAIN, result
