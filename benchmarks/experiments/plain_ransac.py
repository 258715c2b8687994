# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""RANSAC as in the paper: so many samples, the model with the most support, nothing else.

R9P is scored by its own model, which is no rigid motion (Kukelova and others, ACCV 2018, sec. 4):

    lambda x = (I + [v]x) R0 X + C + r (R_RS R0 X + t)

Taking a motion from it leaves out what of R_RS no rotation can follow, and most of its inliers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.experiments import methods as m
from benchmarks.experiments.methods import Method
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.rig import Mounts
from rs_localizer.core.shutter import Motion
from rs_localizer.core.so3 import hat
from rs_localizer.core.state import STATE_ANGULAR, STATE_LINEAR, STATE_TRANSLATION, rotation_of
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.ransac import best_models, draw, generator
from rs_localizer.solvers.batch import MODEL_SIZE
from rs_localizer.solvers.table import find_solver

# Nearer to the pace of the rows any row sees the point.
_LEAST_PACE = 0.1
_TINY = 1e-13


@dataclass(frozen=True, slots=True, eq=False)
class Best:
    """The best minimal model of a frame."""

    # Row times (n,) -> matrices (n,3,3) and translations (n,3) that take the centred points to the
    # camera; None: no model.
    poses_at: Callable[[Array], tuple[Array, Array]] | None
    rotation: Array  # (3,3) at the middle row, to start other solvers from
    inliers: int


@dataclass(frozen=True, slots=True, eq=False)
class PlainRansac:
    """One frame, and what the search may spend on it."""

    observations: Observations  # of centred points
    by_ray: Array  # (n,2,2)
    samples: int  # all of them are drawn
    threshold: float  # px, of an inlier and of the truncated error by which models are ranked
    seed: int

    @classmethod
    def of(
        cls, camera: Camera, points: Array, pixels: Array, samples: int, threshold: float, seed: int
    ) -> PlainRansac:
        """Points (n,3) and their raw pixels (n,2)."""
        rays = camera.rays(pixels)
        usable = np.flatnonzero(np.isfinite(rays).all(axis=1))
        rays, points = rays[usable], points[usable]
        by_ray = camera.pixel_jacobian(rays)
        observations = Observations.of(
            points - points.mean(axis=0), rays, camera.row_time(pixels[usable]), by_ray,
            Mounts.one(camera.row_time_gradient),
        )  # fmt: skip
        return cls(observations, by_ray, samples, threshold, seed)

    def best(self, method: Method, rotation: Array | None = None) -> Best:
        """The best model of all samples; that of R9P is its own, which is no motion.

        Args:
            rotation: initial rotation (3,3); the identity by default.
        """
        rotation = np.eye(3) if rotation is None else rotation
        if len(self.observations) < find_solver(method.solver).sample_size:
            return Best(None, rotation, 0)
        found = self._free if method.solver == m.R9P.solver else self._rigid
        return found(method, self._drawn(method), rotation)

    def _rigid(self, method: Method, drawn: IntArray, rotation: Array) -> Best:
        solver, observations = find_solver(method.solver), self.observations
        models = np.empty((solver.solutions, MODEL_SIZE, len(drawn)))
        solve = solver.solve_as_published if method.as_published else solver.solve
        solve(
            observations.points, observations.rays, observations.tau, drawn, rotation[None],
            method.iterations, models,
        )  # fmt: skip
        states, costs = best_models(models, observations.packed, self.threshold, 1, math.inf)
        if not math.isfinite(costs[0]):
            return Best(None, rotation, 0)
        state = states[0]
        motion = Motion(
            rotation_of(state), state[STATE_TRANSLATION], state[STATE_ANGULAR], state[STATE_LINEAR]
        )
        near = observations.squared_errors(state) < self.threshold**2
        return Best(motion.at_rows, motion.rotation, int(np.count_nonzero(near)))

    def _free(self, method: Method, drawn: IntArray, rotation: Array) -> Best:
        observations = self.observations
        sample = observations.points[drawn], observations.rays[drawn], observations.tau[drawn]
        models = free_models(*sample, rotation, method.as_published)
        squared = free_errors(models, observations, self.by_ray)
        best = int(np.argmin(np.minimum(squared, self.threshold**2).sum(axis=1)))
        at, rate = models[best, :, :4], models[best, :, 4:]

        def poses_at(tau: Array) -> tuple[Array, Array]:
            rows = at + np.multiply.outer(tau, rate)
            return rows[:, :, :3], rows[:, :, 3]

        return Best(poses_at, rotation, int(np.count_nonzero(squared[best] < self.threshold**2)))

    def _drawn(self, method: Method) -> IntArray:
        count = len(self.observations)
        drawn = np.empty((self.samples, find_solver(method.solver).sample_size), dtype=np.int64)
        draw(
            np.arange(count), np.full(self.samples, count), self.observations.tau,
            float(np.ptp(self.observations.tau)), generator(self.seed), drawn,
        )  # fmt: skip
        return drawn


def free_models(
    points: Array, rays: Array, tau: Array, rotation: Array, as_published: bool
) -> Array:
    """R9P's models (h,3,8) of samples of nine points: what takes ``(X, 1, r X, r)`` to the camera.

    As published, all eighteen equations in v, C, t and the nine entries of R_RS are solved; else
    the trace of R_RS is zero.
    """
    turned = points @ rotation.T
    kinds = np.zeros((*tau.shape, 2, 3))  # the first two rows of [x]x, negative
    kinds[..., 0, 0] = kinds[..., 1, 1] = 1.0
    kinds[..., 2] = -rays
    skew = np.cross(turned[..., None, :], -np.eye(3))  # [X]x, rows
    swept = np.einsum("hnki,hnj,hn->hnkij", kinds, turned, tau)
    matrix = np.concatenate(
        [-kinds @ skew, kinds, kinds * tau[..., None, None], swept.reshape(*kinds.shape[:3], 9)], -1
    ).reshape(len(tau), 18, 18)
    right = -np.einsum("hnki,hni->hnk", kinds, turned).reshape(len(tau), 18, 1)
    if as_published:
        # A plane is degenerate: without the addend a matrix may be singular to the last bit.
        found = np.linalg.solve(matrix + _TINY * np.eye(18), right)[..., 0]
    else:
        trace = np.eye(18)[:, :17]
        trace[17, [9, 13]] = -1.0
        q, r = np.linalg.qr(matrix @ trace)
        found = (trace @ np.linalg.solve(r + _TINY * np.eye(17), np.swapaxes(q, 1, 2) @ right))[
            ..., 0
        ]
    v, centre, drift = found[:, :3], found[:, 3:6, None], found[:, 6:9, None]
    start = (np.eye(3) + np.array([hat(one) for one in v])) @ rotation
    return np.concatenate([start, centre, found[:, 9:].reshape(-1, 3, 3) @ rotation, drift], 2)


def free_errors(models: Array, observations: Observations, by_ray: Array) -> Array:
    """Squared reprojection errors (h,n) in raw pixels, at the row that sees the point; infinite
    behind the camera.
    """
    homogeneous = np.column_stack([observations.points, np.ones(len(observations.points))]).T
    at, rate = models[:, :, :4] @ homogeneous, models[:, :, 4:] @ homogeneous
    seen = at + observations.tau * rate
    ray = seen[:, :2] / seen[:, 2:]
    by_row = (rate[:, :2] - ray * rate[:, 2:]) / seen[:, 2:]
    off = np.einsum("nij,hjn->hin", by_ray, ray - observations.rays.T)
    pace = np.einsum("nij,hjn->hin", by_ray, by_row)
    gradient = observations.mounts.gradients[0]
    left = 1.0 - np.einsum("i,hin->hn", gradient, pace)
    squared: Array = np.sum((off + pace * (gradient @ off / left)[:, None]) ** 2, axis=1)
    bad = ~((seen[:, 2] > 0.0) & (left > _LEAST_PACE))
    squared[bad | np.isnan(squared)] = np.inf
    return squared
