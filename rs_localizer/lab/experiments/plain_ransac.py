"""RANSAC as in the paper: so many samples, the model with the most support, nothing else."""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.state import STATE_SIZE
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.ransac import MODEL_SIZE
from rs_localizer.estimation.sampling import draw, generator
from rs_localizer.estimation.scoring import best_models
from rs_localizer.lab.experiments.methods import Method
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
        camera.row_time_gradient,
    )


def best_of_samples(
    observations: Observations,
    method: Method,
    rotation: Array,
    samples: int,
    threshold: float,
    seed: int,
) -> tuple[Array, int]:
    """State (24,) of the best minimal model and its number of inliers.

    Args:
        rotation: initial rotation (3,3).
        samples: all of them are drawn.
        threshold: px, of an inlier and of the truncated error by which models are ranked.
    """
    solver = find_solver(method.solver)
    count = len(observations)
    if count < solver.sample_size:
        return np.full(STATE_SIZE, np.nan), 0
    drawn = np.empty((samples, solver.sample_size), dtype=np.int64)
    draw(
        np.arange(count), np.full(samples, count), observations.tau,
        float(np.ptp(observations.tau)), generator(seed), drawn,
    )  # fmt: skip
    models = np.empty((solver.solutions, MODEL_SIZE, samples))
    solve = solver.solve_as_published if method.as_published else solver.solve
    solve(
        observations.points, observations.rays, observations.tau, drawn, rotation[None],
        method.iterations, models,
    )  # fmt: skip
    states, costs = best_models(
        models, observations.packed, observations.row_time_gradient, threshold, 1, math.inf
    )
    if not math.isfinite(costs[0]):
        return np.full(STATE_SIZE, np.nan), 0
    inliers = observations.squared_errors(states[0]) < threshold**2
    return states[0], int(np.count_nonzero(inliers))
