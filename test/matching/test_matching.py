# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Matches against plain loops; what passes, what is kept, what is refused."""

from typing import Any

import numpy as np
import pytest

from rs_localizer.io.clouds import Keypoints
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.matching import Index, Matcher, Visible


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
