# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What the viewer draws: shapes by their definitions, not by the code's own formulas."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import rs_localizer as rsl
from rs_localizer.core.arrays import Array
from rs_localizer.io.outputs import Localized, Pose
from rs_localizer.offline.viewing import ellipsoid, readout_path, reproject

K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = rsl.Camera(width=640, height=480, K=K, readout_time=0.03)
ROW = np.dtype([(name, "<f8") for name in ("x", "y", "z", "u", "v", "residual")])


def localized(points: Array, pixels: Array) -> Localized:
    """A camera that moves 0.2 m to the right within its readout, and looks along z."""
    rows = np.zeros(len(points), ROW)
    for name, values in zip("xyzuv", np.hstack([points, pixels]).T, strict=True):
        rows[name] = values
    estimate = rsl.Estimate(
        rotation=np.eye(3),
        translation=np.array([0.0, 0.0, 1.0]),
        angular_velocity=np.zeros(3),
        linear_velocity=np.array([0.2, 0.0, 0.0]),
        inliers=np.ones(len(points), np.bool_),
        residuals=np.full(len(points), 0.3),
        joint_covariance=np.eye(18),
        global_shutter_inliers=0,
        iterations=0,
    )
    pose = Pose(np.array([0.0, 0.0, -1.0]), np.eye(3), np.eye(6))
    return Localized(0, 0, "map", "camera", pose, None, rows, 0, estimate)


def test_the_ellipsoid_holds_95_percent():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    covariance = root @ root.T
    half_sizes, quaternion = ellipsoid(covariance)
    axes = Rotation.from_quat(quaternion).as_matrix()
    samples = rng.multivariate_normal(np.zeros(3), covariance, 20_000)
    inside = np.sum((samples @ axes / half_sizes) ** 2, axis=1) <= 1.0
    assert np.mean(inside) == pytest.approx(0.95, abs=0.01)
    assert np.prod(half_sizes) == pytest.approx(
        np.sqrt(np.linalg.det(covariance)) * chi2.ppf(0.95, 3) ** 1.5, rel=1e-4
    )


def test_reprojections_are_of_the_row_that_sees_the_point():
    """At a depth of 2 m, where a metre is 250 px; at tau the camera has gone 0.2 tau to the right,
    so that the point appears as much to the left."""
    points = np.array([[0.0, y, 1.0] for y in (-0.8, 0.0, 0.8)])
    found = reproject(localized(points, np.full((3, 2), 100.0)), CAMERA)
    rows = 239.5 + 250.0 * points[:, 1]
    columns = 319.5 - 250.0 * 0.2 * (rows - 239.5) / 479.0
    np.testing.assert_allclose(found.predicted, np.stack([columns, rows], axis=1), atol=1e-6)
    assert found.pixels.tolist() == [[100.0, 100.0]] * 3
    # From blue, above, to yellow, below.
    assert found.colours[0, 2] > found.colours[1, 2] > found.colours[2, 2]
    assert found.colours[0, 0] < found.colours[1, 0] < found.colours[2, 0]
    way = readout_path(localized(points, points[:, :2]))
    expected = [[x, 0.0, -1.0] for x in (-0.1, 0.0, 0.1)]
    np.testing.assert_allclose(way[[0, 4, -1]], expected, atol=1e-12)
