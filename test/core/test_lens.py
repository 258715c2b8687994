# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Distortion that a calibration lacks, against Brown's and Kannala's formulas written out."""

import numpy as np
import pytest

from rs_localizer.core.camera import Camera
from rs_localizer.core.lens import by_lens, coefficients_of, corner_of, with_lens

K = np.array([[420.0, 0.0, 320.0], [0.0, 420.0, 240.0], [0.0, 0.0, 1.0]])
RAYS = np.random.default_rng(0).uniform(-0.6, 0.6, (20, 2))
FOUND = np.array([-0.03, 0.01, 4e-4, -3e-4])


def camera(model="plumb_bob", D=()):
    return Camera(width=640, height=480, K=K, D=np.array(D), distortion_model=model)


def test_a_mended_lens_draws_points_along_the_radius_and_aside():
    given = camera()
    mended = with_lens(given, FOUND)
    x, y = RAYS.T
    square = (x * x + y * y) / corner_of(given) ** 2
    radial = 1.0 + FOUND[0] * square + FOUND[1] * square**2
    c, d = FOUND[2:] / corner_of(given)
    seen = np.column_stack([
        x * radial + 2.0 * c * x * y + d * (3.0 * x * x + y * y),
        y * radial + c * (x * x + 3.0 * y * y) + 2.0 * d * x * y,
    ])  # fmt: skip
    np.testing.assert_allclose(mended.distort(RAYS)[0], 420.0 * seen + (320.0, 240.0), atol=1e-9)


def test_fisheyes_have_powers_of_the_angle():
    given = camera("equidistant", [0.01, -0.002, 0.0, 0.0])
    assert coefficients_of(given) == 6
    mended = with_lens(given, FOUND[:2])
    angle = np.arctan(np.hypot(*RAYS.T))
    more = 420.0 * angle * (
        FOUND[0] * (angle / corner_of(given)) ** 2 + FOUND[1] * (angle / corner_of(given)) ** 4
    )  # fmt: skip
    moved = mended.distort(RAYS)[0] - given.distort(RAYS)[0]
    np.testing.assert_allclose(np.hypot(*moved.T), np.abs(more), atol=1e-9)


@pytest.mark.parametrize(
    ("model", "D"),
    [
        ("plumb_bob", []),
        ("plumb_bob", [-0.2, 0.05, 5e-4, -5e-4, 0.01]),
        ("rational_polynomial", [0.3, 0.1, 1e-3, 1e-3, 0.02, 0.5, 0.2, 0.01]),
        ("equidistant", [0.01, -0.002, 0.001, 0.0]),
    ],
)
def test_derivatives_say_where_pixels_move(model, D):
    given = camera(model, D)
    count = coefficients_of(given)
    small = 1e-5 * np.array([1.0, -2.0, 0.5, 0.3, 1.5, -1.0, 0.7, 2.0])[:count]
    mended = with_lens(given, small)
    moved = mended.distort(RAYS)[0] - given.distort(RAYS)[0]
    np.testing.assert_allclose(by_lens(given, RAYS) @ small, moved, atol=1e-5)
