# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Every lens law: derivatives are finite differences, and rays come back from their pixels.

Those that see behind the image plane are compared with the formulas of their papers, written out
point by point; distortion that a calibration lacks, with Brown's and Kannala's.
"""

import math

import numpy as np
import pytest

from rs_localizer.core.camera import Camera, DistortionModel, Roi
from rs_localizer.core.lens import by_lens, coefficients_of, corner_of, with_lens

K = np.array([[520.0, 0.0, 310.0], [0.0, 500.0, 250.0], [0.0, 0.0, 1.0]])
RAYS = np.random.default_rng(3).uniform(-0.5, 0.5, (40, 2))
STEP = 1e-6
# Coefficients of real lenses of about 200 degrees, and the angle to the axis up to which they see.
WIDE = {
    DistortionModel.EQUIDISTANT: ([0.01, -0.004, 0.002, -3e-4], 1.8),
    DistortionModel.EUCM: ([0.63, 1.05], 1.9),
    DistortionModel.DOUBLE_SPHERE: ([-0.2, 0.59], 1.9),
}


def coefficients(model: DistortionModel) -> np.ndarray:
    """Small ones, as many as a law may have; of those with limits, some of a wide lens."""
    if model.law.limits is not None:
        return np.array(WIDE[model][0])
    return np.random.default_rng(4).uniform(-0.02, 0.02, max(model.law.counts))


@pytest.mark.parametrize("model", DistortionModel)
def test_derivatives_are_finite_differences(model):
    law, D = model.law, coefficients(model)
    projected = law.project(RAYS, K, D)
    for axis, step in enumerate(STEP * np.eye(2)):
        ends = [law.project(RAYS + sign * step, K, D).pixels for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * STEP)
        np.testing.assert_allclose(projected.by_ray[:, :, axis], slope, atol=1e-4)
    for column, place in enumerate([(0, 0), (1, 1), (0, 2), (1, 2)]):
        ends = []
        for sign in (1, -1):
            matrix = K.copy()
            matrix[place] += sign * STEP
            ends.append(law.project(RAYS, matrix, D).pixels)
        slope = (ends[0] - ends[1]) / (2 * STEP)
        np.testing.assert_allclose(projected.by_matrix[:, :, column], slope, atol=1e-6)
    for k, step in enumerate(STEP * np.eye(len(D))):
        ends = [law.project(RAYS, K, D + sign * step).pixels for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * STEP)
        np.testing.assert_allclose(projected.by_coefficients[:, :, k], slope, atol=1e-4)


def khomutenko(x, y, z, alpha, beta):
    """Equation 12 of the paper."""
    rho = math.sqrt(z * z + beta * (x * x + y * y))
    eta = (1.0 - alpha) * z + alpha * rho
    return x / eta, y / eta


def usenko(x, y, z, xi, alpha):
    """Equation 40 of the paper."""
    d1 = math.sqrt(x * x + y * y + z * z)
    d2 = math.sqrt(x * x + y * y + (xi * d1 + z) ** 2)
    below = alpha * d2 + (1.0 - alpha) * (xi * d1 + z)
    return x / below, y / below


def kannala(x, y, z, *k):
    """Equations 6 and 7 of the paper."""
    angle, azimuth = math.acos(z / math.sqrt(x * x + y * y + z * z)), math.atan2(y, x)
    radius = angle + sum(c * angle ** (2 * power + 3) for power, c in enumerate(k))
    return radius * math.cos(azimuth), radius * math.sin(azimuth)


PAPERS = {
    DistortionModel.EQUIDISTANT: kannala,
    DistortionModel.EUCM: khomutenko,
    DistortionModel.DOUBLE_SPHERE: usenko,
}


def directions(most, count=200):
    """Points (n,3) at any distance within an angle to the axis, and one on it."""
    rng = np.random.default_rng(5)
    angle, azimuth = rng.uniform(0.0, most, count), rng.uniform(-np.pi, np.pi, count)
    across = np.sin(angle)
    unit = np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), np.cos(angle)])
    return np.vstack([rng.uniform(0.2, 5.0, (count, 1)) * unit, [[0.0, 0.0, 2.0]]])


@pytest.mark.parametrize("model", WIDE)
def test_wide_lenses_are_those_of_their_papers(model):
    D, most = WIDE[model]
    points = directions(most)
    camera = Camera(640, 480, K, D, model, binning=(2, 2), roi=Roi(20, 10, 400, 300))
    places = np.array([PAPERS[model](*point, *D) for point in points])
    expected = (places * (520.0, 500.0) + (310.0, 250.0) - (20.0, 10.0)) / 2.0
    np.testing.assert_allclose(camera.project(points), expected, rtol=1e-12, atol=1e-9)
    assert (points[:, 2] < 0.0).sum() > 15  # behind the image plane
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(camera.bearings(expected), unit, atol=1e-8)
    # Rays are x/z, y/z, and of what lies behind there are none.
    ahead = unit[:, 2] > 0.1
    rays = camera.rays(expected)
    np.testing.assert_allclose(rays[ahead], (points[:, :2] / points[:, 2:])[ahead], atol=1e-5)
    assert np.isnan(rays[points[:, 2] < 0.0]).all()


@pytest.mark.parametrize("model", WIDE)
def test_wide_lenses_say_what_they_do_not_see(model):
    camera = Camera(640, 480, K, WIDE[model][0], model)
    assert np.isnan(camera.project(np.array([[0.0, 1e-3, -1.0]]))).all()
    assert np.isnan(camera.bearings(np.array([[310.0, 1e5]]))).all()


@pytest.mark.parametrize("model", [DistortionModel.EUCM, DistortionModel.DOUBLE_SPHERE])
def test_closed_formulas_have_limits_and_corrections_keep_them(model):
    D, _ = WIDE[model]
    with pytest.raises(ValueError, match=f"D of {model} must lie within"):
        Camera(640, 480, K, np.array(D) + 1.5, model)
    camera = Camera(640, 480, K, D, model)
    count = coefficients_of(camera)
    # A coefficient of 1 moves the corner by its distance from the centre, outwards.
    edge = np.array([[corner_of(camera), 0.0]])
    moved = by_lens(camera, edge)[0, 0, :2]
    np.testing.assert_allclose(moved, 520.0 * corner_of(camera), rtol=1e-9)
    for size in (0.01, 10.0):
        with_lens(camera, np.append([size, -2.0 * size], np.zeros(count - 2)))


FOUND = np.array([-0.03, 0.01, 4e-4, -3e-4])


def test_a_mended_lens_draws_points_along_the_radius_and_aside():
    given = Camera(640, 480, K)
    x, y = RAYS.T
    square = (x * x + y * y) / corner_of(given) ** 2
    radial = 1.0 + FOUND[0] * square + FOUND[1] * square**2
    c, d = FOUND[2:] / corner_of(given)
    seen = np.column_stack([
        x * radial + 2.0 * c * x * y + d * (3.0 * x * x + y * y),
        y * radial + c * (x * x + 3.0 * y * y) + 2.0 * d * x * y,
    ])  # fmt: skip
    pixels = with_lens(given, FOUND).distort(RAYS)[0]
    np.testing.assert_allclose(pixels, seen * (520.0, 500.0) + (310.0, 250.0), atol=1e-9)


def test_fisheyes_have_powers_of_the_angle():
    square = np.diag([420.0, 420.0, 1.0])
    given = Camera(
        640,
        480,
        square + K * [[0, 0, 1], [0, 0, 1], [0, 0, 0]],
        WIDE["equidistant"][0],
        "equidistant",
    )
    assert coefficients_of(given) == 6
    angle = np.arctan(np.hypot(*RAYS.T))
    powers = (angle / corner_of(given)) ** 2, (angle / corner_of(given)) ** 4
    moved = with_lens(given, FOUND[:2]).distort(RAYS)[0] - given.distort(RAYS)[0]
    more = 420.0 * angle * (FOUND[0] * powers[0] + FOUND[1] * powers[1])
    np.testing.assert_allclose(np.hypot(*moved.T), np.abs(more), atol=1e-9)


@pytest.mark.parametrize("model", DistortionModel)
def test_derivatives_say_where_pixels_move(model):
    given = Camera(640, 480, K, coefficients(model), model)
    small = 1e-5 * np.array([1.0, -2.0, 0.5, 0.3, 1.5, -1.0, 0.7, 2.0])[: coefficients_of(given)]
    moved = with_lens(given, small).distort(RAYS)[0] - given.distort(RAYS)[0]
    np.testing.assert_allclose(by_lens(given, RAYS) @ small, moved, atol=1e-5)
