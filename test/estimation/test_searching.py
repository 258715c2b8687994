# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How long the search goes on: ``max_iterations`` does what it says."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer import Camera, Localizer

K = np.array([[1200.0, 0.0, 499.5], [0.0, 1200.0, 499.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(1000, 1000, K)
TURN, WAY = np.radians(10.0), 0.1  # per readout


def frame(seed, outliers, count=200, turn=TURN, way=WAY):
    """Points and pixels of a camera that turns and moves: the points lie on the rays of pixels."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(0.0, 999.0, (count, 2))
    tau = pixels[:, 1] / 999.0 - 0.5
    axis, along = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
    local = rng.uniform(1.0, 4.0, count)[:, None] * np.column_stack(
        [(pixels - 499.5) / 1200.0, np.ones(count)]
    )
    # The camera at the middle row is the map.
    points = Rotation.from_rotvec(turn * tau[:, None] * axis).apply(local)
    points += way * tau[:, None] * along
    measured = pixels + rng.normal(size=(count, 2))
    wrong = round(outliers * count)
    measured[:wrong] = rng.uniform(0.0, 999.0, (wrong, 2))
    return points, measured


def test_of_an_ordinary_frame_no_more_samples_are_drawn():
    """Those of the default, however many there may be."""
    for outliers in (0.0, 0.5, 0.7):
        for seed in range(5):
            default, patient = (
                Localizer(CAMERA, max_iterations=most).localize(*frame(seed, outliers))
                for most in (1000, 1_000_000)
            )
            assert default.iterations == patient.iterations <= 128
            np.testing.assert_array_equal(default.rotation, patient.rotation)


def before_a_plane(seed):
    """Points and pixels of a plane 0.6 m wide, 2 m before a camera that turns and moves."""
    rng = np.random.default_rng(seed)
    pixels = 499.5 + rng.uniform(-180.0, 180.0, (50, 2))
    tau = pixels[:, 1] / 999.0 - 0.5
    axis, along = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
    rays = np.column_stack([(pixels - 499.5) / 1200.0, np.ones(50)])
    rays = Rotation.from_rotvec(TURN * tau[:, None] * axis).apply(rays)
    position = WAY * tau[:, None] * along
    points = position + rays * ((2.0 - position[:, 2:]) / rays[:, 2:])
    return points, pixels + rng.normal(size=(50, 2))


@pytest.mark.parametrize("frames", [10, pytest.param(40, marks=pytest.mark.bench)])
def test_a_fast_camera_before_a_plane_that_faces_it_is_found(frames):
    """From the global-shutter pose, which leans, one in four was not, after all the samples."""
    localizer = Localizer(CAMERA)
    for seed in range(frames):
        estimate = localizer.localize(*before_a_plane(seed))
        assert estimate
        assert estimate.iterations <= 128
        assert Rotation.from_matrix(estimate.rotation).magnitude() < np.radians(6.0)
