# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Points from keypoints of cameras whose motion is known."""

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.tools.mapping.triangulation import Sights, triangulate

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
