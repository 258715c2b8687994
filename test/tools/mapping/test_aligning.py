# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Maps in another frame: what was wished holds, and nothing else changes."""

from dataclasses import replace

import numpy as np
import pytest

from rs_localizer.core import so3
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Marker, Pose
from rs_localizer.tools.mapping.gauge import alignment, moved_map

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
