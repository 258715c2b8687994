# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Markers among what is adjusted."""

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.mapping.anchors import marker_constraints
from rs_localizer.mapping.gauge import Similarity
from rs_localizer.mapping.observations import MapObservations, Start

K = np.array([[400.0, 0.0, 319.5], [0.0, 400.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(640, 480, K)
IMAGES = 6
# How the first map lies in the markers' frame.
TURN = Rotation.from_euler("xyz", [20.0, -30.0, 70.0], degrees=True).as_matrix()
TO_MARKERS = Similarity(0.7, TURN, np.array([1.0, 2.0, 3.0]))
RNG = np.random.default_rng(0)
POINTS = RNG.uniform((-1.0, -1.0, 2.5), (1.0, 1.0, 3.5), (20, 3))
CORNERS = RNG.uniform((-1.0, -1.0, 2.5), (1.0, 1.0, 3.5), (8, 3))
ROTATIONS = Rotation.from_rotvec(RNG.normal(0.0, 0.05, (IMAGES, 3))).as_matrix()
POSITIONS = np.column_stack([np.linspace(-0.5, 0.5, IMAGES), np.zeros((IMAGES, 2))])
STAMPS = 10**9 + 66_000_000 * np.arange(IMAGES)


def sightings(points: np.ndarray, images: range = range(IMAGES)) -> MapObservations:
    rows, which = (
        grid.ravel() for grid in np.meshgrid(images, np.arange(len(points)), indexing="ij")
    )
    local = np.einsum("nji,nj->ni", ROTATIONS[rows], points[which] - POSITIONS[rows])
    return MapObservations(STAMPS, rows, which, CAMERA.project(local))


def test_the_start_moves_into_the_markers_frame():
    start = Start(POINTS, ROTATIONS, POSITIONS)
    places = TO_MARKERS(CORNERS)
    seen, moved, freedom = marker_constraints(
        CAMERA, sightings(POINTS), start, sightings(CORNERS), places
    )
    assert np.allclose(moved.points, np.concatenate([TO_MARKERS(POINTS), places]), atol=1e-6)
    assert np.allclose(moved.positions, TO_MARKERS(POSITIONS), atol=1e-6)
    assert np.allclose(moved.rotations, TURN @ ROTATIONS, atol=1e-6)
    assert freedom.deviations is not None
    assert np.isinf(freedom.deviations[:20]).all()
    assert np.all(freedom.deviations[20:] < 0.01)
    assert np.all(np.diff(seen.images) >= 0)
    # The same keypoints as before, and those of the corners behind the landmarks.
    assert len(seen.pixels) == IMAGES * 28
    at = seen.landmarks >= 20
    local = CAMERA.project(
        np.einsum(
            "nji,nj->ni",
            moved.rotations[seen.images[at]],
            moved.points[seen.landmarks[at]] - moved.positions[seen.images[at]],
        )
    )
    assert np.allclose(local, seen.pixels[at], atol=1e-3)


def test_markers_that_are_hardly_seen_hold_nothing():
    start = Start(POINTS, ROTATIONS, POSITIONS)
    given = sightings(POINTS)
    corners = sightings(CORNERS[:3])
    seen, moved, freedom = marker_constraints(CAMERA, given, start, corners, TO_MARKERS(CORNERS))
    assert seen is given
    assert moved is start
    assert freedom.deviations is None
