# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""RANSAC as in the paper: so many samples, the model with the most support, nothing else."""

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
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.so3 import hat
from rs_localizer.core.state import STATE_ANGULAR, STATE_LINEAR, STATE_TRANSLATION, rotation_of
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.ransac import best_models, draw, generator
from rs_localizer.solvers.batch import MODEL_SIZE
from rs_localizer.solvers.r9p import solve_free
from rs_localizer.solvers.table import find_solver

# As of motions: nearer to the pace of the rows any row sees the point, and the second look is taken
# no farther away.
_LEAST_PACE = 0.1
_FARTHEST_LOOK = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class FreeMotion:
    """How points reach the camera, row by row, when nothing says that the way is a rotation.

        lambda x = (I + [v]x) R0 X + C + r (R_RS R0 X + t)

    with a free 3x3 matrix R_RS (Kukelova, Albl, Sugimoto, Pajdla, ACCV 2018, sec. 4): R9P's own
    model. Taking a motion from it leaves out what of R_RS no rotation can follow, and most of its
    inliers with it. Errors are measured as those of motions (estimation/residuals.py): where the
    model puts the point on the image, at the row that sees it there.
    """

    model: Array  # (3,8), takes (X, 1, r X, r) to the camera

    def at_rows(self, tau: Array) -> tuple[Array, Array]:
        """Matrices (n,3,3) and translations (n,3) at row times (n,); no rotations."""
        rows = self.model[:, :4] + np.multiply.outer(tau, self.model[:, 4:])
        return rows[:, :, :3], rows[:, :, 3]

    def squared_errors(self, observations: Observations, by_ray: Array) -> Array:
        """Squared reprojection errors (n,) in raw pixels; infinite behind the camera.

        Args:
            by_ray: (n,2,2) derivatives of the pixels by the rays.
        """
        errors: Array = _squared_errors(
            self.model, observations.points, observations.rays, observations.tau, by_ray,
            observations.mounts.gradients[0], 2,
        )  # fmt: skip
        return errors


def solve_all(
    observations: Observations, samples: IntArray, rotation: Array, as_published: bool
) -> Array:
    """Models (h,3,8) of samples (h,9) from an initial rotation (3,3); NaN where there is none."""
    found = np.empty((MODEL_SIZE, len(samples)))
    solve_free(
        observations.points, observations.rays, observations.tau, samples, rotation[None],
        as_published, found,
    )  # fmt: skip
    v, translation, drift = found[:9].reshape(3, 3, -1).transpose(0, 2, 1)
    matrices = (np.eye(3) + np.array([hat(x) for x in v])) @ rotation
    swept = found[9:].T.reshape(-1, 3, 3) @ rotation
    return np.concatenate([matrices, translation[..., None], swept, drift[..., None]], axis=2)


def best_free_motion(
    models: Array, observations: Observations, by_ray: Array, scale: float
) -> FreeMotion | None:
    """Of models (h,3,8) the one with the least squared error, truncated at ``scale`` px."""
    costs = _costs(
        models, observations.points, observations.rays, observations.tau, by_ray,
        observations.mounts.gradients[0], scale,
    )  # fmt: skip
    best = int(np.argmin(costs))
    return FreeMotion(models[best]) if np.isfinite(costs[best]) else None


@kernel
def _costs(
    models: Array, points: Array, rays: Array, tau: Array, by_ray: Array, gradient: Array,
    scale: float,
) -> Array:  # fmt: skip
    """Truncated squared errors (h,) of all models; infinite where there is none."""
    costs = np.empty(len(models))
    for h in range(len(models)):
        costs[h] = np.inf
        if np.isfinite(models[h]).all():
            errors = _squared_errors(models[h], points, rays, tau, by_ray, gradient, 1)
            costs[h] = np.minimum(errors, scale * scale).sum()
    return costs


@kernel
def _squared_errors(
    model: Array, points: Array, rays: Array, tau: Array, by_ray: Array, gradient: Array, looks: int
) -> Array:
    errors = np.empty(len(points))
    at, rate = np.empty(3), np.empty(3)
    for i in range(len(points)):
        for k in range(3):
            at[k], rate[k] = model[k, 3], model[k, 7]
            for j in range(3):
                at[k] += model[k, j] * points[i, j]
                rate[k] += model[k, 4 + j] * points[i, j]
        x, y, shift = 0.0, 0.0, 0.0
        for _ in range(looks):
            r = tau[i] + shift
            z = at[2] + r * rate[2]
            u, v = (at[0] + r * rate[0]) / z, (at[1] + r * rate[1]) / z
            by_row_u, by_row_v = (rate[0] - u * rate[2]) / z, (rate[1] - v * rate[2]) / z
            # Seen from here, the point was less far on at the measured row.
            off_u = u - rays[i, 0] - shift * by_row_u
            off_v = v - rays[i, 1] - shift * by_row_v
            x = by_ray[i, 0, 0] * off_u + by_ray[i, 0, 1] * off_v
            y = by_ray[i, 1, 0] * off_u + by_ray[i, 1, 1] * off_v
            by_row_x = by_ray[i, 0, 0] * by_row_u + by_ray[i, 0, 1] * by_row_v
            by_row_y = by_ray[i, 1, 0] * by_row_u + by_ray[i, 1, 1] * by_row_v
            pace = 1.0 - gradient[0] * by_row_x - gradient[1] * by_row_y
            if not (z > 0.0 and pace > _LEAST_PACE):
                x, y = np.inf, np.inf
                break
            lag = (gradient[0] * x + gradient[1] * y) / pace
            x, y = x + by_row_x * lag, y + by_row_y * lag
            shift = gradient[0] * x + gradient[1] * y
            shift = min(max(shift, -_FARTHEST_LOOK), _FARTHEST_LOOK)
        errors[i] = x * x + y * y
    return errors


def observe(camera: Camera, points: Array, pixels: Array) -> Observations:
    """Points (n,3) and raw pixels (n,2) for the kernels, with the points' centre at the origin."""
    rays = camera.rays(pixels)
    usable = np.flatnonzero(np.isfinite(rays).all(axis=1))
    return Observations.of(
        points[usable] - points[usable].mean(axis=0),
        rays[usable],
        camera.row_time(pixels[usable]),
        camera.pixel_jacobian(rays[usable]),
        Mounts.one(camera.row_time_gradient),
    )


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
        observations = observe(camera, points, pixels)
        by_ray = camera.pixel_jacobian(observations.rays)
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
        states, costs = best_models(
            models, observations.packed, self.threshold, 1,
            math.inf,
        )  # fmt: skip
        if not math.isfinite(costs[0]):
            return Best(None, rotation, 0)
        state = states[0]
        motion = Motion(
            rotation_of(state), state[STATE_TRANSLATION], state[STATE_ANGULAR], state[STATE_LINEAR]
        )
        return Best(motion.at_rows, motion.rotation,
                    self._inliers(observations.squared_errors(state)))  # fmt: skip

    def _free(self, method: Method, drawn: IntArray, rotation: Array) -> Best:
        models = solve_all(self.observations, drawn, rotation, method.as_published)
        motion = best_free_motion(models, self.observations, self.by_ray, self.threshold)
        if motion is None:
            return Best(None, rotation, 0)
        errors = motion.squared_errors(self.observations, self.by_ray)
        return Best(motion.at_rows, rotation, self._inliers(errors))

    def _inliers(self, squared_errors: Array) -> int:
        return int(np.count_nonzero(squared_errors < self.threshold**2))

    def _drawn(self, method: Method) -> IntArray:
        count = len(self.observations)
        drawn = np.empty((self.samples, find_solver(method.solver).sample_size), dtype=np.int64)
        draw(
            np.arange(count), np.full(self.samples, count), self.observations.tau,
            float(np.ptp(self.observations.tau)), generator(self.seed), drawn,
        )  # fmt: skip
        return drawn
