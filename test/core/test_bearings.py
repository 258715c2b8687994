# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Bearings of many pixels at once, against OpenCV's."""

import numpy as np
import pytest

from rs_localizer.core.bearings import bearings
from rs_localizer.core.camera import Camera, Roi

K = np.array([[500.0, 0.0, 321.0], [0.0, 510.0, 238.0], [0.0, 0.0, 1.0]])
CURVED = [0.5, 0.1, 0.001, 0.001, 0.01, 0.8, 0.2, 0.03]
LENSES = [
    ("plumb_bob", []),
    ("plumb_bob", [-0.3, 0.1, 0.002, -0.001]),
    ("plumb_bob", [0.4, 0.1, 0.002, -0.001, 0.01]),
    ("rational_polynomial", CURVED),
    ("rational_polynomial", [*CURVED, 0.01, 0.003, -0.02, 0.004]),
    ("rational_polynomial", [*CURVED, 0.01, 0.003, -0.02, 0.004, 0.02, -0.03]),
    ("equidistant", [0.05, 0.01, 0.001, 0.0]),
]


def pixels(count=203):
    return np.random.default_rng(0).uniform([0, 0], [639, 479], (count, 2))


@pytest.mark.parametrize(("model", "D"), LENSES)
@pytest.mark.parametrize("part", [{}, {"binning": (2, 3), "roi": Roi(100, 60, 400, 300)}])
def test_bearings_and_derivatives_are_those_of_opencv(model, D, part):
    camera = Camera(640, 480, K, D, distortion_model=model, **part)
    raw = pixels() / camera.binning
    for ours, theirs in zip(bearings(camera, raw), camera.rays_and_jacobian(raw), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-9)


def test_what_has_no_bearing_has_none_and_harms_no_neighbour():
    camera = Camera(640, 480, K, [-0.5, 0.0, 0.0, 0.0, 0.0])
    raw = np.array([321.0, 238.0]) + 0.3 * (pixels(19) - (320, 240))
    # The polynomial r (1 - r^2/2) never exceeds 0.55: no bearing reaches these pixels.
    raw[[2, 5]] = [1500.0, 238.0], [321.0, -900.0]
    rays, _ = bearings(camera, raw)
    np.testing.assert_array_equal(np.isnan(rays[:, 0]), np.isin(np.arange(19), [2, 5]))
    np.testing.assert_allclose(rays, camera.rays(raw), rtol=1e-7, atol=1e-9)
    assert [a.shape for a in bearings(camera, np.zeros((0, 2)))] == [(0, 2), (0, 2, 2)]
