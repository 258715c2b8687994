# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Distortion that a calibration lacks, against Brown's and Kannala's formulas written out."""

import numpy as np
import pytest

from rs_localizer.core.camera import Camera
from rs_localizer.core.lens import LensError, by_lens, coefficients_of, corner_of

K = np.array([[420.0, 0.0, 320.0], [0.0, 420.0, 240.0], [0.0, 0.0, 1.0]])
RAYS = np.random.default_rng(0).uniform(-0.6, 0.6, (20, 2))
FOUND = np.array([-0.03, 0.01, 4e-4, -3e-4])


def camera(model="plumb_bob", D=()):
    return Camera(width=640, height=480, K=K, D=np.array(D), distortion_model=model)


def test_a_mended_lens_draws_points_along_the_radius_and_aside():
    given = camera()
    mended = LensError(FOUND, np.eye(4), 400.0).mended(given)
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
    mended = LensError(FOUND[:2], np.eye(2), 400.0).mended(given)
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
    mended = LensError(small, np.eye(count), 400.0).mended(given)
    moved = mended.distort(RAYS)[0] - given.distort(RAYS)[0]
    np.testing.assert_allclose(by_lens(given, RAYS) @ small, moved, atol=1e-5)


def test_pixels_are_those_of_the_point_that_moves_farthest():
    # Outwards, then back: farthest where the derivative 3 a r^2 + 5 b r^4 is zero.
    lens = LensError(np.array([0.05, -0.055]), np.eye(2), 400.0)
    far = np.sqrt(0.15 / 0.275)
    assert lens.pixels == pytest.approx(400.0 * (0.05 * far**3 - 0.055 * far**5), rel=0.01)


def test_what_a_wrong_focal_length_moves_is_said():
    # It was 0.0 px: only the radial part counted. At the corner 3 % are 0.03 times its distance.
    given = Camera(640, 480, np.array([[420.0, 0.0, 319.5], [0.0, 420.0, 239.5], [0.0, 0.0, 1.0]]))
    corner = given.focal_length * corner_of(given)
    for mean in (
        [0.0, 0.0, 0.0, 0.0, 0.03, 0.03, 0.0, 0.0],
        [0.01, -0.02, 0.003, -0.002, 0.01, 0.02, 0.004, 0.003],
    ):
        lens = LensError(np.array(mean), np.eye(8), corner)
        turn = np.linspace(0.0, 2.0 * np.pi, 200)
        rim = corner_of(given) * np.column_stack([np.cos(turn), np.sin(turn)])
        rays = np.concatenate([share * rim for share in np.linspace(0.0, 1.0, 50)])
        moved = lens.mended(given).distort(rays)[0] - given.distort(rays)[0]
        assert lens.pixels == pytest.approx(np.linalg.norm(moved, axis=1).max(), rel=0.02)
