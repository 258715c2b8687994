# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Matches against plain loops; predicted landmarks against the exact projection."""

from typing import Any

import numpy as np
import pytest

from rs_localizer.core import so3
from rs_localizer.core.camera import Camera, Roi
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.estimation.prior import Prior
from rs_localizer.io.clouds import Keypoints
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.matching import Index, Matcher, Visible, predict_visible
from rs_localizer.tools.simulation.scene import room

from ..moving import pinhole  # noqa: TID252 - Python has a package "test"


def make_map(count: int, ids: Any = None, descriptors: Any = None) -> Map:
    return Map(np.zeros((count, 3)), ids, descriptors, "map")


def keypoints(count: int, ids: Any = None, descriptors: Any = None, scores: Any = None) -> Any:
    return Keypoints(0, np.zeros((count, 2)), ids, descriptors, scores, 0)


def descriptors(kind: str, count: int, width: int, seed: int) -> Any:
    rng = np.random.default_rng(seed)
    if kind == "bits":  # few bits differ, so that many distances are equal
        return rng.integers(0, 2, (count, width), dtype=np.uint8) * 255
    return rng.normal(size=(count, width)).astype(np.float32)


def distances(one: Any, other: Any) -> Any:
    """(n,m) by the definition."""
    if one.dtype == np.uint8:
        return np.unpackbits(one[:, None] ^ other, axis=2).sum(axis=2).astype(float)
    return np.linalg.norm(one[:, None].astype(float) - other, axis=2)


@pytest.mark.parametrize("kind", ["bits", "numbers"])
@pytest.mark.parametrize("width", [1, 32, 61])
@pytest.mark.parametrize("count", [1, 2, 5000])  # more than a block holds
def test_the_two_nearest_of_all(kind, width, count):
    landmarks, queries = descriptors(kind, count, width, 0), descriptors(kind, 9, width, 1)
    found = Index(landmarks, binary=kind == "bits").nearest(queries)
    table = distances(queries, landmarks)
    order = np.argsort(table, axis=1, kind="stable")[:, :2]
    expected = np.take_along_axis(table, order, 1)
    nearest = found.landmarks[:, : order.shape[1]]
    np.testing.assert_allclose(found.distances[:, : order.shape[1]], expected, rtol=1e-5)
    np.testing.assert_allclose(np.take_along_axis(table, nearest, 1), expected, rtol=1e-5)
    if kind == "bits":  # no rounding: the first ones of equal distance
        assert nearest.tolist() == order.tolist()
    if count == 1:
        assert np.all(np.isinf(found.distances[:, 1]))
        assert np.all(found.landmarks[:, 1] == -1)


@pytest.mark.parametrize("kind", ["bits", "numbers"])
def test_the_two_nearest_within_the_gate(kind):
    rng = np.random.default_rng(0)
    landmarks, queries = descriptors(kind, 200, 32, 0), descriptors(kind, 30, 32, 1)
    pixels, predicted = rng.uniform(0, 100, (30, 2)), rng.uniform(0, 100, (80, 2))
    rows = rng.permutation(200)[:80]
    order = np.argsort(predicted[:, 1])
    visible = Visible(rows[order], predicted[order], 15.0)
    found, owners = Index(landmarks, binary=kind == "bits").nearest_within(queries, pixels, visible)
    table = distances(queries, landmarks[rows])
    table[np.linalg.norm(pixels[:, None] - predicted[None], axis=2) > 15.0] = np.inf
    expected = np.sort(table, axis=1)[:, :2]
    there = np.isfinite(expected)
    np.testing.assert_allclose(found.distances, expected, rtol=1e-5)
    assert not there[:, 1].all()
    np.testing.assert_array_equal(found.landmarks >= 0, there)
    everywhere = np.full((30, 200), np.inf)
    everywhere[:, rows] = table
    at_found = np.take_along_axis(everywhere, found.landmarks, 1)
    np.testing.assert_allclose(at_found[there], expected[there], rtol=1e-5)
    nearest, own = table[:, order].min(axis=0), np.flatnonzero(owners >= 0)
    np.testing.assert_array_equal(owners >= 0, np.isfinite(nearest))
    np.testing.assert_allclose(table[owners[own], order[own]], nearest[own], rtol=1e-5)


def matched(matcher: Matcher, points: Keypoints) -> dict[int, int]:
    found = matcher.match(points)
    return dict(zip(found.keypoints.tolist(), found.landmarks.tolist(), strict=True))


def test_an_id_that_comes_twice_in_an_image():
    matcher = Matcher(make_map(2, ids=np.array([1, 2])))
    ids = np.array([2, 1, 2, 1])
    assert matched(matcher, keypoints(4, ids=ids)) == {0: 1, 1: 0}
    best = matcher.match(keypoints(4, ids=ids, scores=np.array([1.0, 2.0, 3.0, 4.0])))
    found = zip(best.keypoints, best.landmarks, best.scores, strict=True)
    assert list(found) == [(2, 1, 3.0), (3, 0, 4.0)]


def bits(*counts: int) -> Any:
    """Descriptors of 4 bytes with so many bits set, the same ones first."""
    rows = [(2**count - 1).to_bytes(4, "little") for count in counts]
    return np.array([list(row) for row in rows], np.uint8)


def test_the_ratio_test():
    matcher = Matcher(make_map(2, descriptors=bits(0, 20)))
    # Distances to the landmarks: 4 and 16, 11 and 9; each landmark has a keypoint of its own.
    given = keypoints(2, descriptors=bits(4, 11))
    assert matched(matcher, given) == {0: 0}
    found = matcher.match(given)
    assert found.scores.tolist() == [1.0 - 4 / 16]


def test_the_mutual_check_and_the_best_of_several():
    matcher = Matcher(make_map(2, descriptors=bits(0, 30)))
    # Two keypoints like the first landmark; the second is the nearer one.
    given = keypoints(3, descriptors=bits(3, 2, 29))
    assert matched(matcher, given) == {1: 0, 2: 1}
    # The same distance twice: the first.
    assert matched(matcher, keypoints(2, descriptors=bits(2, 2))) == {0: 0}


CAMERAS: dict[str, dict[str, Any]] = {
    "ideal": {},
    "sideways": {"scan_direction": "right_to_left"},
    "distorted": {"D": np.array([-0.25, 0.05, 1e-3, -1e-3, 0.0])},
    "fisheye": {"D": np.array([0.05, -0.01, 0.0, 0.0]), "distortion_model": "equidistant"},
    "part": {"binning": (2, 2), "roi": Roi(100, 60, 400, 300)},
}
MOTION = Motion(
    so3.exp(np.array([0.2, -0.4, 0.1])), *np.array([[0.3, -0.1, 0.4], [0.1, -0.2, 0.3],
                                                    [0.05, -0.03, 0.1]]),
)  # fmt: skip
SURE = Prior(motion=MOTION, covariance=1e-10 * np.eye(12))


@pytest.fixture(scope="module")
def points() -> Any:
    return room(np.zeros((1, 3)), np.random.default_rng(0), count=20_000)


@pytest.mark.parametrize("name", list(CAMERAS))
def test_all_that_the_image_shows_is_predicted_where_it_is(name, points):
    view = pinhole(400.0, **CAMERAS[name])
    pixels, _ = project_rolling(view, MOTION.at_rows, points)
    shown = np.flatnonzero(view.inside(pixels))
    assert len(shown) > 300
    found = predict_visible(view, SURE, points, 20.0)
    assert found.gate == 20.0
    assert np.all(np.diff(found.pixels[:, 1]) >= 0.0)
    place = {row: k for k, row in enumerate(found.landmarks.tolist())}
    # A lens model folds what is far outside into the image: of those some are not predicted.
    straight = shown[are_seen(view, points[shown], pixels[shown])].tolist()
    assert len(straight) > 300
    assert set(straight) <= set(place)
    # The camera turns by 21 degrees while the image is read.
    errors = np.abs(found.pixels[[place[row] for row in straight]] - pixels[straight]).max(axis=1)
    assert np.quantile(errors, 0.9) < 0.2
    assert errors.max() < 2.0
    # And not much else: not the whole room.
    assert len(found.landmarks) < 3 * len(shown) < 0.9 * len(points)


def are_seen(view: Camera, points: Any, pixels: Any) -> Any:
    """Whether each pixel's bearing, at its own row, meets its point."""
    rotations, translations = MOTION.at_rows(view.row_time(pixels))
    x, y, z = (np.einsum("nij,nj->ni", rotations, points) + translations).T
    return (z > 0.0) & (np.abs(view.rays(pixels) - np.c_[x / z, y / z]).max(axis=1) < 1e-3)


def test_a_prediction_tells_apart_what_looks_the_same(points):
    """Only a hundred kinds of landmarks: by their looks alone none is recognized."""
    view = pinhole(400.0)
    rng = np.random.default_rng(1)
    descriptors = rng.integers(0, 256, (100, 32), dtype=np.uint8)[rng.integers(0, 100, len(points))]
    pixels, _ = project_rolling(view, MOTION.at_rows, points)
    shown = rng.permutation(np.flatnonzero(view.inside(pixels)))[:200]
    seen = pixels[shown] + rng.normal(0.0, 0.5, (200, 2))
    given = Keypoints(0, seen, None, descriptors[shown], None, 0)
    matcher = Matcher(Map(points, None, descriptors, "map"))
    assert len(matcher.match(given)) == 0
    found = matcher.match(given, view, SURE)
    assert len(found) > 120
    assert np.mean(found.landmarks == shown[found.keypoints]) > 0.95
    assert len(set(found.landmarks.tolist())) == len(found)
