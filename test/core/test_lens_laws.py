# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Every lens law: derivatives are finite differences, and rays come back from their pixels."""

from __future__ import annotations

import numpy as np
import pytest

from rs_localizer.core.camera import Camera, DistortionModel

K = np.array([[520.0, 0.0, 310.0], [0.0, 500.0, 250.0], [0.0, 0.0, 1.0]])
RAYS = np.random.default_rng(3).uniform(-0.5, 0.5, (40, 2))
STEP = 1e-6


def coefficients(model: DistortionModel) -> np.ndarray:
    """Small ones, as many as a law may have."""
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


@pytest.mark.parametrize("model", DistortionModel)
def test_rays_come_back_from_their_pixels(model):
    for count in model.law.counts:
        camera = Camera(640, 480, K, coefficients(model)[:count], model)
        np.testing.assert_allclose(camera.rays(camera.distort(RAYS)[0]), RAYS, atol=1e-6)


@pytest.mark.parametrize("model", DistortionModel)
def test_a_single_image_corrects_the_lowest_powers_only(model):
    orders = model.law.correctable
    assert orders[:2] == (0, 1)
    assert all(order is None or order < 2 for order in orders)
