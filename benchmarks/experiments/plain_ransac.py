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
from benchmarks.experiments.own_model import best_free_motion, solve_all
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.rig import Mounts
from rs_localizer.core.shutter import Motion
from rs_localizer.core.state import STATE_ANGULAR, STATE_LINEAR, STATE_TRANSLATION, rotation_of
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.ransac import best_models, draw, generator
from rs_localizer.solvers.batch import MODEL_SIZE
from rs_localizer.solvers.table import find_solver


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
