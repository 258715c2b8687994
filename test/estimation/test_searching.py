# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How long the search goes on: ``max_iterations`` does what it says."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer import Localizer

from ..moving import pinhole  # noqa: TID252 - Python has a package "test"

CAMERA = pinhole(1200.0, 1000, 1000, readout_time=0.0)
TURN, WAY = np.radians(10.0), 0.1  # per readout


def frame(seed, count=200, outliers=0.0, plane=None):
    """Points and pixels of a camera that turns and moves; at the middle row it is the map.

    Points lie on the rays of pixels, in a plane 0.6 m wide at this distance, or at any depth.
    """
    rng = np.random.default_rng(seed)
    pixels = 499.5 + rng.uniform(-1.0, 1.0, (count, 2)) * (499.5 if plane is None else 180.0)
    tau = pixels[:, 1:] / 999.0 - 0.5
    axis, along = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
    rays = np.column_stack([(pixels - 499.5) / 1200.0, np.ones(count)])
    rays, places = Rotation.from_rotvec(TURN * tau * axis).apply(rays), WAY * tau * along
    depths = rng.uniform(1.0, 4.0, (count, 1))
    if plane is not None:
        depths = (plane - places[:, 2:]) / rays[:, 2:]
    measured = pixels + rng.normal(size=(count, 2))
    wrong = round(outliers * count)
    measured[:wrong] = rng.uniform(0.0, 999.0, (wrong, 2))
    return places + depths * rays, measured


@pytest.mark.parametrize("outliers", [0.0, 0.5, 0.7])
def test_of_an_ordinary_frame_no_more_samples_are_drawn(outliers):
    for seed in range(5):
        default, patient = (
            Localizer(CAMERA, max_iterations=most).localize(*frame(seed, outliers=outliers))
            for most in (1000, 1_000_000)
        )
        assert default.iterations == patient.iterations <= 128
        np.testing.assert_array_equal(default.rotation, patient.rotation)


@pytest.mark.parametrize("frames", [10, pytest.param(40, marks=pytest.mark.bench)])
def test_a_fast_camera_before_a_plane_that_faces_it_is_found(frames):
    """The global-shutter pose, from which the search starts, leans."""
    localizer = Localizer(CAMERA)
    for seed in range(frames):
        estimate = localizer.localize(*frame(seed, 50, plane=2.0))
        assert estimate
        assert estimate.iterations <= 128
        assert Rotation.from_matrix(estimate.rotation).magnitude() < np.radians(6.0)
