# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Scale and place of a map."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.tools.mapping.anchors import Anchors, PointSight, placement
from rs_localizer.tools.mapping.gauge import Similarity
from rs_localizer.tools.mapping.triangulation import Triangulated

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
