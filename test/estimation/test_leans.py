# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Modes before a plane, against plain integrals over a grid of leans."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.estimation.leans import Frame, linear_at, mode_of, over_leans
from rs_localizer.estimation.linear_fit import Noise
from rs_localizer.estimation.prior import held_terms
from rs_localizer.estimation.smooth_error import nothing_shared

from .frames import fitted, observe
from .projection import in_camera, pixels_of

COUNT = 40
STEP = 1e-6


def plane_frame(seed, tilt, noise):
    """Points of a plane of 0.2 m at 1.6 m that leans by ``tilt`` deg, seen by a camera at rest."""
    rng = np.random.default_rng(seed)
    points = np.c_[rng.uniform(-0.1, 0.1, (COUNT, 2)), np.zeros(COUNT)]
    points -= np.median(points, axis=0)
    rotation = Rotation.from_euler("x", tilt, degrees=True).as_matrix()
    state = np.concatenate([rotation.ravel(), [0.0, 0.0, 1.6], np.zeros(12)])
    noisy = np.random.default_rng(seed + 1)
    seen = in_camera(state, np.zeros(COUNT), points, np.zeros((COUNT, 3)))
    pixels = pixels_of(seen[:, :2] / seen[:, 2:])
    pixels = pixels + noise * np.random.default_rng(seed + 1).normal(size=pixels.shape)
    return observe(state, points, noise, noisy), points, pixels, state


def errors_of(points, pixels, rotation, translation):
    seen = points @ rotation.T + translation
    return (pixels_of(seen[:, :2] / seen[:, 2:]) - pixels).ravel()


def beside(points, pixels, rotation, translation, axes):
    """Best squared errors over turns about some axes and moves, and volume of what is left."""
    for _ in range(4):
        errors = errors_of(points, pixels, rotation, translation)
        columns = []
        for axis in axes:
            turned = Rotation.from_rotvec(STEP * axis).as_matrix() @ rotation
            columns.append(errors_of(points, pixels, turned, translation))
        for shift in STEP * np.eye(3):
            columns.append(errors_of(points, pixels, rotation, translation + shift))
        jacobian = (np.column_stack(columns) - errors[:, None]) / STEP
        step = -np.linalg.lstsq(jacobian, errors, rcond=None)[0]
        turn = Rotation.from_rotvec(axes.T @ step[: len(axes)]).as_matrix()
        rotation, translation = turn @ rotation, translation + step[len(axes) :]
    return np.sum(errors**2), -0.5 * np.linalg.slogdet(jacobian.T @ jacobian)[1]


@pytest.mark.parametrize(("tilt", "noise"), [(0.0, 0.5), (12.0, 1.0)])
def test_leans_are_integrated_as_on_a_fine_grid(tilt, noise):
    observations, points, pixels, truth = plane_frame(3, tilt, noise)
    terms = held_terms()
    best = fitted(observations, truth, terms, 4.0)
    assert np.all(best.inliers)
    smooth = nothing_shared(COUNT)
    noise = Noise(best.noise, 1.0, 2.0 * COUNT - best.freedom)
    seen = Frame(observations.packed, points, best.inliers, smooth, noise, 590.0, 1.6)
    mode, _, _ = mode_of(seen, best.state, linear_at(seen, best.state), terms)
    found = over_leans(seen, mode, terms)
    rotation, translation = mode.state[:9].reshape(3, 3), mode.state[9:12]
    normal = rotation[:, 2]
    across = np.linalg.svd(normal[None])[2][1:]
    grid = np.radians(np.arange(-36.0, 36.1, 2.0 if tilt == 0.0 else 3.0))
    freedom = best.freedom
    squares, volumes = np.empty((2, len(grid), len(grid)))
    for i, a in enumerate(grid):
        for j, b in enumerate(grid):
            turn = Rotation.from_rotvec(a * across[0] + b * across[1]).as_matrix()
            squares[i, j], volumes[i, j] = beside(
                points, pixels, turn @ rotation, translation, (turn @ normal)[None]
            )
    # The noise is any: its logarithm is integrated out.
    logarithms = volumes - 0.5 * freedom * np.log(squares)
    weights = np.exp(logarithms - logarithms.max())
    assert (
        max(weights[0].max(), weights[-1].max(), weights[:, 0].max(), weights[:, -1].max()) < 1e-2
    )
    total = weights.sum()
    places = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1)
    mean = np.tensordot(weights, places, 2) / total
    spread = np.sqrt(np.tensordot(weights, (places - mean) ** 2, 2) / total)
    turned = Rotation.from_matrix(found.state[:9].reshape(3, 3) @ rotation.T).as_rotvec()
    np.testing.assert_allclose(across @ turned, mean, atol=0.1 * spread.max())
    deviations = np.sqrt(np.diag(across @ found.covariance[:3, :3] @ across.T))
    np.testing.assert_allclose(deviations, spread, rtol=0.1)
    # More than the Gaussian about the optimum, by as much as the grid says.
    whole = np.log(total) + logarithms.max() + np.log((grid[1] - grid[0]) ** 2 / (2.0 * np.pi))
    square, volume = beside(points, pixels, rotation, translation, np.vstack([normal, across]))
    one = volume - 0.5 * freedom * np.log(square) + 2.0 * np.log(best.noise)
    assert found.evidence - mode.evidence == pytest.approx(whole - one, abs=0.1)
