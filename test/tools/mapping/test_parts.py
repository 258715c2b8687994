# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Parts of map making: filming, triangulation, anchors, alignment, clustered errors."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.core.camera import Camera
from rs_localizer.features.extraction import Features
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.markers.prints import Marker, Pose
from rs_localizer.tools.adjust.fit import pull_at_landmarks
from rs_localizer.tools.mapping.anchors import Anchors, PointSight, placement
from rs_localizer.tools.mapping.build import comes_back
from rs_localizer.tools.mapping.gauge import Similarity, alignment, moved_map
from rs_localizer.tools.mapping.map_keypoints import MapObservations
from rs_localizer.tools.mapping.structure import SeenImage, choose_keyframes
from rs_localizer.tools.mapping.triangulation import Sights, Triangulated, triangulate


def views_of(sharpnesses: list[float]) -> list[SeenImage]:
    nothing = Features(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 128), np.uint8))
    none = np.zeros(0, np.int64)
    return [
        SeenImage(round(k * 1e9 / 15.0), Path(), nothing, value, np.zeros((0, 2)), none)
        for k, value in enumerate(sharpnesses)
    ]


def test_of_a_long_one_the_sharpest_four_a_second_are():
    values = np.random.default_rng(0).uniform(1.0, 2.0, 900).tolist()
    rows = choose_keyframes(views_of(values)).tolist()
    assert len(rows) == 240
    assert max(np.diff(rows)) <= 8
    assert np.mean([values[row] for row in rows]) > np.mean(values) + 0.2


@pytest.mark.parametrize(("way", "back"), [("on", False), ("there and back", True)])
def test_a_walk_comes_back_if_its_ends_show_the_same(way, back):
    """Along a wall of landmarks, 40 of which an image shows."""
    places = np.arange(60) if way == "on" else np.r_[np.arange(30), np.arange(30)[::-1]]
    landmarks = (10 * places[:, None] + np.arange(40)).ravel()
    images = np.repeat(np.arange(60), 40)
    seen = MapObservations(10**9 * np.arange(60), images, landmarks, np.zeros((2400, 2)))
    assert comes_back(seen) == back


RATE, LANDMARKS, SECONDS = 30, 60, 10


def alike(rng: np.random.Generator, shape: tuple[int, ...], share: float) -> np.ndarray:
    """Errors of variance 1 in time (the first axis): such a share of one image goes on."""
    fresh = rng.normal(size=shape)
    errors = fresh.copy()
    for k in range(1, len(errors)):
        errors[k] = share * errors[k - 1] + np.sqrt(1.0 - share**2) * fresh[k]
    return errors


@pytest.mark.parametrize("share", [0.0, 0.7])
def test_what_errors_pull_at_landmarks_is_their_long_run_variance(share):
    rng = np.random.default_rng(0)
    times = np.repeat(np.arange(RATE * SECONDS) / RATE, LANDMARKS)
    landmarks = np.tile(np.arange(LANDMARKS), RATE * SECONDS)
    errors = alike(rng, (RATE * SECONDS, LANDMARKS, 2), share).reshape(-1, 2)
    first, last = rng.normal(size=(2, LANDMARKS, 2, 3))
    gone = (times / SECONDS)[:, None, None]
    own = (1.0 - gone) * first[landmarks] + gone * last[landmarks]
    # What is left of the errors, the landmarks estimated.
    left = np.empty_like(errors)
    for landmark in range(LANDMARKS):
        of = landmarks == landmark
        rows = own[of].reshape(-1, 3)
        fit = np.linalg.lstsq(rows, errors[of].ravel(), rcond=None)[0]
        left[of] = errors[of] - (rows @ fit).reshape(-1, 2)
    measured, expected = pull_at_landmarks(
        np.concatenate([own, left[..., None]], axis=2), landmarks, times, np.zeros(LANDMARKS)
    )
    assert measured / expected == pytest.approx((1.0 + share) / (1.0 - share), rel=0.2)


K = np.array([[400.0, 0.0, 319.5], [0.0, 400.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(640, 480, K, np.array([-0.1, 0.02, 0.001, -0.001]))


def scene(noise: float, seed: int = 0) -> tuple[np.ndarray, Sights]:
    """Points 3 m before cameras that stand along a line and look a little askew."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-1.0, -1.0, 2.5), (1.0, 1.0, 3.5), (40, 3))
    rotations = Rotation.from_rotvec(rng.normal(0.0, 0.05, (12, 3))).as_matrix()
    positions = np.column_stack([np.linspace(-0.5, 0.5, 12), rng.normal(0.0, 0.1, (12, 2))])
    which, where = (grid.ravel() for grid in np.meshgrid(np.arange(40), np.arange(12)))
    local = np.einsum("nji,nj->ni", rotations[where], points[which] - positions[where])
    pixels = CAMERA.project(local) + noise * rng.standard_normal((len(local), 2))
    return points, Sights(rotations[where], positions[where], pixels, which)


def test_points_come_back():
    points, seen = scene(0.0)
    found = triangulate(CAMERA, seen, 40)
    assert np.abs(found.points - points).max() < 1e-6
    assert found.counts.tolist() == 40 * [12]


def test_wrong_keypoints_do_not_matter():
    points, seen = scene(0.0)
    wrong = np.random.default_rng(1).choice(len(seen.pixels), 40, replace=False)
    seen.pixels[wrong] += (60.0, -35.0)
    found = triangulate(CAMERA, seen, 40)
    errors = np.linalg.norm(found.points - points, axis=1)
    assert np.median(errors) < 1e-4
    assert np.mean(errors < 1e-2) > 0.9


def test_covariances_are_honest():
    """Squared errors in terms of the covariance: three on average."""
    squared = []
    for seed in range(20):
        points, seen = scene(0.5, seed)
        found = triangulate(CAMERA, seen, 40)
        error = found.points - points
        squared.append(np.einsum("pi,pij,pj->p", error, np.linalg.inv(found.covariances), error))
    assert 2.6 < np.mean(squared) < 3.5


def test_what_is_not_determined_is_not_told():
    """Seen once; seen from one place only; not seen at all."""
    _, seen = scene(0.1)
    rows = np.flatnonzero(seen.points < 2)
    once = rows[(seen.points[rows] == 0)][:1]
    there = rows[seen.points[rows] == 1]
    kept = np.concatenate([once, np.repeat(there[:1], 5)])
    part = Sights(seen.rotations[kept], seen.positions[kept], seen.pixels[kept], seen.points[kept])
    assert np.isnan(triangulate(CAMERA, part, 3).points).all()
    nothing = Sights(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0, int))
    assert triangulate(CAMERA, nothing, 2).points.shape == (2, 3)
    assert triangulate(CAMERA, nothing, 0).points.shape == (0, 3)


WALL = MarkerMap(wall("4x4_50", (3, 2), 0.2, 0.1))
TO_MAP = Similarity(
    0.4, Rotation.from_euler("xyz", [30, 40, 50], degrees=True).as_matrix(), np.ones(3)
)
# A camera that is held level, and nods and turns about the vertical of its own frame (y down).
HELD = Rotation.from_euler("YX", [[a, b] for a in (0, 50, 200) for b in (-20, 5)], degrees=True)


def found(points: np.ndarray) -> Triangulated:
    count = len(points)
    return Triangulated(points, np.tile(np.eye(3), (count, 1, 1)), np.full(count, 9), 0.1)


def back(points: np.ndarray) -> np.ndarray:
    """Where points of the map are before it is placed."""
    return (points - TO_MAP.translation) @ TO_MAP.rotation / TO_MAP.scale


def placed(anchors: Anchors, points: np.ndarray):
    return placement(anchors, found(points), HELD.as_matrix(), np.zeros((6, 3)))


def test_markers_give_frame_and_scale():
    placement = placed(Anchors(WALL), back(WALL.points))
    assert placement.scaled
    assert np.allclose(placement.similarity(back(WALL.points)), WALL.points)
    assert "24 corners of markers, within 0.0 mm (rms)" in placement.basis


def test_a_marker_that_was_seen_briefly_moves_no_map():
    points, covariances = WALL.points.copy(), np.tile(1e-8 * np.eye(3), (len(WALL.points), 1, 1))
    points[:4] += [0.0, 0.02, 0.03]
    covariances[:4] = 0.03**2 * np.eye(3)
    seen = Triangulated(back(points), covariances, np.full(len(points), 9), 0.1)
    placement_of = placement(Anchors(WALL), seen, HELD.as_matrix(), np.zeros((6, 3)))
    off = placement_of.similarity(back(WALL.points)) - WALL.points
    assert np.abs(off).max() < 1e-4


def test_a_wrong_marker_map_is_refused():
    points = back(WALL.points)
    points[:4] += 0.5
    with pytest.raises(ValueError, match="do not lie where their map says"):
        placed(Anchors(WALL), points)


def sights(*names: str) -> tuple[PointSight, ...]:
    return tuple(PointSight(name, view, (1.0, 2.0)) for name in names for view in (0, 1))


def test_a_distance_gives_the_scale():
    points = np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    placement = placed(Anchors(None, sights("a", "b"), ("a", "b", 3.0)), points)
    assert placement.scaled
    assert placement.similarity.scale == pytest.approx(1.5)
    # Without anything better, the picture's rows are level: y of the camera's frame is down.
    assert np.allclose(placement.similarity.rotation @ [0.0, 1.0, 0.0], [0.0, 0.0, -1.0])


TURN = so3.exp(np.array([0.4, -0.7, 0.2]))


def room() -> Map:
    """Three landmarks on the floor of a turned room in units of 0.5 m, and more above it."""
    rng = np.random.default_rng(0)
    level = rng.uniform(0.2, 2.0, (20, 3))
    level[:4, 2] = 0.0
    covariances = np.tile(np.diag([1.0, 4.0, 9.0]) * 1e-4, (20, 1, 1))
    points = (2.0 * level + [3.0, 1.0, 2.0]) @ TURN.T
    modes = np.zeros((20, 3, 2), np.float32)
    modes[:, :, 1] = level
    return Map(points, np.arange(20), None, "map", covariances=covariances, error_modes=modes)


def test_up_size_and_origin():
    by = alignment(room(), distance=(4, 9, 1.5), up=tuple(TURN[:, 2]), origin=2)
    found = moved_map(room(), by)
    np.testing.assert_allclose(found.points[:4, 2], 0.0, atol=1e-12)
    assert np.all(found.points[4:, 2] > 0.0)
    np.testing.assert_allclose(found.points[2], 0.0, atol=1e-12)
    assert np.linalg.norm(found.points[4] - found.points[9]) == pytest.approx(1.5)
    before = np.linalg.norm(room().points[:, None] - room().points, axis=2)
    after = np.linalg.norm(found.points[:, None] - found.points, axis=2)
    scale = after[4, 9] / before[4, 9]
    np.testing.assert_allclose(after, scale * before, atol=1e-12)
    traces = np.trace(found.covariances, axis1=1, axis2=2)
    np.testing.assert_allclose(traces, scale**2 * 14e-4)
    lengths = np.linalg.norm(room().error_modes[:, :, 1], axis=1)
    np.testing.assert_allclose(
        np.linalg.norm(found.error_modes, axis=1), scale * lengths[:, None] * [0.0, 1.0], rtol=1e-5
    )


@pytest.mark.parametrize("up", [(0.0, 0.0, 2.0), (0.0, 0.0, -1.0), (1.0, -2.0, 0.5)])
def test_up(up):
    by = alignment(room(), up=up)
    np.testing.assert_allclose(by.rotation @ up, [0.0, 0.0, np.linalg.norm(up)], atol=1e-12)
    assert np.linalg.det(by.rotation) == pytest.approx(1.0)


def test_markers():
    known = np.array([0.001, 0.001, 0.001, 0.01, 0.01, 0.01])
    hung = Marker.at("4x4_50", 3, 0.2, Pose(np.array([1.0, 2.0, 3.0]), TURN))
    other = Marker.at("4x4_50", 5, 0.2, Pose(np.array([1.0, 2.0, 5.0])))
    markers = MarkerMap((replace(hung, deviations=known), other))
    by = alignment(markers, scale=2.0, up=tuple(TURN[:, 1]), origin=3)
    found = moved_map(markers, by).markers
    np.testing.assert_allclose(found[0].pose.rotation[:, 1], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(found[0].pose.position, 0.0, atol=1e-12)
    assert [marker.size for marker in found] == pytest.approx([0.4, 0.4])
    assert np.linalg.norm(found[1].pose.position) == pytest.approx(4.0)
    np.testing.assert_allclose(found[0].deviations, known * [2.0, 2.0, 2.0, 1.0, 1.0, 1.0])


def test_ids_are_named_by_all_their_digits():
    with pytest.raises(ValueError, match=r"no landmark 1234567$"):
        alignment(room(), distance=(1234567.0, 3.0, 1.0))
    one = float(room().ids[3])
    with pytest.raises(ValueError, match=f"--distance: {one:.0f} and {one:.0f} are 0 m apart"):
        alignment(room(), distance=(one, one, 1.0))
