# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Points from keypoints of cameras whose motion is known, each point by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csr_array

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.tools.adjust.problem import MEDIAN

_STEPS = 12
# Tukey's limit in standard deviations, and the errors (px) that are noise in any case.
_LIMIT, _LEAST_DEVIATION = 4.7, 0.1
# The limit (px) closes from this by half from step to step: wrong keypoints pull at first.
_FIRST_LIMIT = 100.0
# Rays that meet at a smaller angle than 0.5 degrees determine no depth: squared sine of half of it.
_LEAST_SPREAD = np.sin(np.radians(0.25)) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class Sights:
    """Keypoints, each with the camera's pose at the time of its row."""

    rotations: Array  # (n,3,3) map_from_camera
    positions: Array  # (n,3)
    pixels: Array  # (n,2) raw
    points: IntArray  # (n,) which point each shows


@dataclass(frozen=True, slots=True, eq=False)
class Triangulated:
    """Points with their covariances."""

    points: Array  # (p,3); NaN: not determined
    covariances: Array  # (p,3,3), of the keypoints' noise alone
    counts: IntArray  # (p,) keypoints that fit
    deviation: float  # px, of the noise of u and of v
    weights: Array = field(default_factory=lambda: np.zeros(0))  # (n,) of the keypoints, 0 to 1

    @property
    def spread(self) -> Array:
        """Standard deviation (p,) of a point's place."""
        return np.asarray(np.sqrt(np.trace(self.covariances, axis1=1, axis2=2)))

    def chosen(self, rows: IntArray) -> Triangulated:
        """Return some (p,) of the points, with the keypoints of all."""
        return replace(
            self, points=self.points[rows], covariances=self.covariances[rows],
            counts=self.counts[rows],
        )  # fmt: skip


def triangulate(camera: Camera, sights: Sights, count: int) -> Triangulated:
    """Return the most likely places of points, robustly.

    Args:
        camera: its lens.
        sights: of what is given; the order does not matter.
        count: of the points.
    """
    if len(sights.points) == 0:
        empty = np.full((count, 3), np.nan)
        return Triangulated(empty, np.full((count, 3, 3), np.nan), np.zeros(count, int), np.nan)
    points = _nearest_to_rays(camera, sights, count)
    deviation = np.inf
    for k in range(_STEPS):
        errors, jacobians = _errors(camera, sights, points)
        squared = np.sum(errors**2, axis=1)
        usable = np.isfinite(squared)
        noise = np.sqrt(np.median(squared[usable]) / MEDIAN) if usable.any() else np.inf
        deviation = max(float(noise), _LEAST_DEVIATION)
        limit = max(_LIMIT * deviation, _FIRST_LIMIT * 0.5**k)
        weights = np.where(usable, np.maximum(1.0 - squared / limit**2, 0.0) ** 2, 0.0)
        errors, jacobians = np.nan_to_num(errors), np.nan_to_num(jacobians)
        weighted = weights[:, None, None] * jacobians
        normal = _sums(np.swapaxes(weighted, 1, 2) @ jacobians, sights.points, count)
        slope = _sums(np.einsum("nij,ni->nj", weighted, errors), sights.points, count)
        points = points - np.einsum("pij,pj->pi", _inverses(normal), slope)
    counts = np.bincount(sights.points[weights > 0.0], minlength=count)
    determined = (counts > 1) & np.isfinite(points).all(axis=1)
    covariances = np.where(determined[:, None, None], deviation**2 * _inverses(normal), np.nan)
    return Triangulated(
        np.where(determined[:, None], points, np.nan), covariances, counts, deviation, weights
    )


def moves(
    camera: Camera, sights: Sights, triangulated: Triangulated,
    others: Sequence[tuple[Camera, Sights]],
) -> Array:  # fmt: skip
    """Return displacements of points (p,3,k) if the same keypoints were seen otherwise.

    To first order, with the weights that they have.

    Args:
        camera, sights: the input of the triangulation.
        others: (k) lenses and poses that are hardly different.
    """
    points, count = triangulated.points, len(triangulated.points)
    errors, jacobians = _errors(camera, sights, points)
    weighted = triangulated.weights[:, None, None] * np.nan_to_num(jacobians)
    inverses = triangulated.covariances / triangulated.deviation**2
    every = np.empty((count, 3, len(others)))
    for k, (lens, seen) in enumerate(others):
        change = np.nan_to_num(_errors(lens, seen, points)[0] - errors)
        slope = _sums(np.einsum("nij,ni->nj", weighted, change), sights.points, count)
        every[:, :, k] = -np.einsum("pij,pj->pi", inverses, slope)
    return every


def _nearest_to_rays(camera: Camera, sights: Sights, count: int) -> Array:
    """Return points (p,3) nearest to the rays; NaN for parallel rays."""
    rays = np.column_stack([camera.rays(sights.pixels), np.ones(len(sights.pixels))])
    directions = np.einsum("nij,nj->ni", sights.rotations, rays)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    usable = np.isfinite(directions).all(axis=1)
    directions = np.nan_to_num(directions)
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    across[~usable] = 0.0
    normal = _sums(across, sights.points, count)
    places = _sums(np.einsum("nij,nj->ni", across, sights.positions), sights.points, count)
    counts = np.bincount(sights.points[usable], minlength=count)
    least = np.linalg.eigvalsh(normal)[:, 0] / np.maximum(counts, 1)
    nearest: Array = np.einsum("pij,pj->pi", _inverses(normal), places)
    nearest[least < _LEAST_SPREAD] = np.nan
    return nearest


def _errors(camera: Camera, sights: Sights, points: Array) -> tuple[Array, Array]:
    """Return errors (n,2) px and their derivatives (n,2,3) by the points; NaN if behind."""
    inverse = np.swapaxes(sights.rotations, 1, 2)
    local = np.einsum("nij,nj->ni", inverse, points[sights.points] - sights.positions)
    depth = np.where(local[:, 2] > 0.0, local[:, 2], np.nan)
    rays = local[:, :2] / depth[:, None]
    by_ray = camera.pixel_jacobian(rays)
    by_local = np.zeros((len(rays), 2, 3))
    by_local[:, 0, 0] = by_local[:, 1, 1] = 1.0
    by_local[:, :, 2] = -rays
    by_point = by_ray @ (by_local / depth[:, None, None]) @ inverse
    return camera.project(local) - sights.pixels, by_point


def _inverses(matrices: Array) -> Array:
    """Return inverses (p,3,3) of symmetric matrices; NaN where there is none."""
    values = np.linalg.eigvalsh(np.nan_to_num(matrices))
    good = values[:, 0] > 1e-10 * np.maximum(values[:, 2], 1e-300)
    inverses = np.full_like(matrices, np.nan)
    inverses[good] = np.linalg.inv(matrices[good])
    return inverses


def _sums(values: Array, groups: IntArray, count: int) -> Array:
    """Return sums (count,...) of values (n,...) by group (n,)."""
    n = len(groups)
    picks = csr_array((np.ones(n), (groups, np.arange(n))), shape=(count, n))
    return np.asarray(picks @ values.reshape(len(values), -1)).reshape(count, *values.shape[1:])
