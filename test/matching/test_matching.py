# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Matches against plain loops; what passes, what is kept, what is refused."""

from typing import Any

import numpy as np
import pytest

from rs_localizer.config import Matching
from rs_localizer.io.clouds import Keypoints
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.matching import Matcher, Visible, make_index


def make_map(count: int, **fields: Any) -> Map:
    return Map(np.zeros((count, 3)), fields.get("ids"), fields.get("descriptors"), "map")


def keypoints(count: int, **fields: Any) -> Keypoints:
    pixels = fields.get("pixels", np.zeros((count, 2)))
    return Keypoints(
        0, pixels, fields.get("ids"), fields.get("descriptors"), fields.get("scores"), 0
    )


def descriptors(kind: str, count: int, width: int, seed: int) -> Any:
    rng = np.random.default_rng(seed)
    if kind == "bits":  # few bits differ, so that many distances are equal
        return rng.integers(0, 2, (count, width), dtype=np.uint8) * 255
    return rng.normal(size=(count, width)).astype(np.float32)


def distances(one: Any, other: Any) -> Any:
    """(n,m) by the definition."""
    if one.dtype == np.uint8:
        table = [
            [sum((int(a) ^ int(b)).bit_count() for a, b in zip(x, y, strict=True)) for y in other]
            for x in one
        ]
    else:
        table = [[np.linalg.norm(x.astype(float) - y.astype(float)) for y in other] for x in one]
    return np.array(table, dtype=float)


@pytest.mark.parametrize("kind", ["bits", "numbers"])
@pytest.mark.parametrize("width", [1, 32, 61])
@pytest.mark.parametrize("count", [1, 2, 300])
def test_the_two_nearest_of_all(kind, width, count):
    landmarks, queries = descriptors(kind, count, width, 0), descriptors(kind, 9, width, 1)
    found = make_index(landmarks, binary=kind == "bits").nearest(queries)
    table = distances(queries, landmarks)
    order = np.argsort(table, axis=1, kind="stable")[:, :2]
    expected = np.take_along_axis(table, order, 1)
    assert np.allclose(found.distances[:, : order.shape[1]], expected, rtol=1e-5)
    at_found = np.take_along_axis(table, found.landmarks[:, : order.shape[1]], 1)
    assert np.allclose(at_found, expected, rtol=1e-5)
    if kind == "bits":  # no rounding: the first ones of equal distance
        assert found.landmarks[:, : order.shape[1]].tolist() == order.tolist()
    if count == 1:
        assert np.all(np.isinf(found.distances[:, 1]))
        assert np.all(found.landmarks[:, 1] == -1)


def test_more_landmarks_than_a_block_holds():
    for kind in ("bits", "numbers"):
        landmarks = descriptors(kind, 5000, 8, 0)
        if kind == "bits":
            landmarks = np.random.default_rng(0).integers(0, 256, (5000, 8), dtype=np.uint8)
        rows = np.array([0, 255, 256, 4095, 4096, 4999])
        found = make_index(landmarks, binary=kind == "bits").nearest(landmarks[rows])
        assert found.landmarks[:, 0].tolist() == rows.tolist()
        assert np.all(found.distances[:, 0] == 0.0)


@pytest.mark.parametrize("kind", ["bits", "numbers"])
def test_the_two_nearest_within_the_gate(kind):
    rng = np.random.default_rng(0)
    landmarks, queries = descriptors(kind, 200, 32, 0), descriptors(kind, 30, 32, 1)
    pixels, predicted = rng.uniform(0, 100, (30, 2)), rng.uniform(0, 100, (80, 2))
    rows = rng.permutation(200)[:80]
    order = np.argsort(predicted[:, 1])
    visible = Visible(rows[order], predicted[order], 15.0)
    found, owners = make_index(landmarks, binary=kind == "bits").nearest_within(
        queries, pixels, visible
    )
    table = distances(queries, landmarks[rows])
    table[np.linalg.norm(pixels[:, None] - predicted[None], axis=2) > 15.0] = np.inf
    expected = np.sort(table, axis=1)[:, :2]
    assert np.allclose(found.distances, expected, rtol=1e-5)
    assert np.any(np.isinf(expected[:, 1]))
    for q in range(30):
        for k in range(2):
            if np.isfinite(expected[q, k]):
                column = rows.tolist().index(found.landmarks[q, k])
                assert np.isclose(table[q, column], expected[q, k], rtol=1e-5)
            else:
                assert found.landmarks[q, k] == -1
    table = table[:, order]
    for column, owner in enumerate(owners):
        if np.isinf(table[:, column].min()):
            assert owner == -1
        else:
            assert np.isclose(table[owner, column], table[:, column].min(), rtol=1e-5)


def matched(matcher: Matcher, points: Keypoints, **settings: Any) -> dict[int, int]:
    found = matcher.match(points, Matching(**settings))
    return dict(zip(found.keypoints.tolist(), found.landmarks.tolist(), strict=True))


def test_an_id_that_comes_twice_in_an_image():
    matcher = Matcher(make_map(2, ids=np.array([1, 2])))
    ids = np.array([2, 1, 2, 1])
    assert matched(matcher, keypoints(4, ids=ids)) == {0: 1, 1: 0}
    best = matcher.match(keypoints(4, ids=ids, scores=np.array([1.0, 2.0, 3.0, 4.0])), Matching())
    assert best.keypoints.tolist() == [2, 3]
    assert best.landmarks.tolist() == [1, 0]
    assert best.scores.tolist() == [3.0, 4.0]


def bits(*counts: int) -> Any:
    """Descriptors of 4 bytes with so many bits set, the same ones first."""
    rows = [(2**count - 1).to_bytes(4, "little") for count in counts]
    return np.array([list(row) for row in rows], np.uint8)


def test_the_ratio_test():
    matcher = Matcher(make_map(2, descriptors=bits(0, 20)))
    # Distances to the landmarks: 4 and 16, 9 and 11.
    given = keypoints(2, descriptors=bits(4, 9))
    assert matched(matcher, given, mutual=False, ratio=0.8) == {0: 0}
    assert matched(matcher, given, mutual=False, ratio=0.25) == {}
    found = matcher.match(given, Matching(ratio=0.8))
    assert found.scores.tolist() == [1.0 - 4 / 16]


def test_the_mutual_check_and_the_best_of_several():
    matcher = Matcher(make_map(2, descriptors=bits(0, 30)))
    # Two keypoints like the first landmark; the second is the nearer one.
    given = keypoints(3, descriptors=bits(3, 2, 29))
    assert matched(matcher, given) == {1: 0, 2: 1}
    assert matched(matcher, given, mutual=False) == {1: 0, 2: 1}
    # The same distance twice: the first.
    assert matched(matcher, keypoints(2, descriptors=bits(2, 2))) == {0: 0}
