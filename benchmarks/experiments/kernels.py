# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Loops over many frames of few points, compiled: scores, refinement, Fisher information."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.rig import Mounts
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.state import MOTION_PARAMETERS, PARAMETERS, STATE_SIZE
from rs_localizer.estimation.observations import pack, weighted
from rs_localizer.estimation.prior import PriorTerms
from rs_localizer.estimation.ransac import optimize, state_of_model
from rs_localizer.estimation.refine import EXPECTED_NOISE, refine
from rs_localizer.estimation.residuals import normal_equations, squared_errors, truncated_cost


@kernel
def best_solutions(
    models: Array,
    points: Array,
    rays: Array,
    tau: Array,
    by_ray: Array,
    mounts: Mounts,
    scale: float,
) -> Array:
    """Of the solutions (h,k,18) of each frame the one with the least truncated error: (h,18).

    Points (h,n,3), rays (h,n,2) and row times (h,n) are all those of the frames; ``by_ray``
    (n,2,2) is the same for all. NaN where a frame has no solution.
    """
    chosen = np.full((len(models), models.shape[2]), np.nan)
    for i in range(len(models)):
        data = pack(points[i], rays[i], tau[i], by_ray, np.zeros(len(by_ray), np.int64), mounts)
        least = np.inf
        for s in range(models.shape[1]):
            if np.isnan(models[i, s, 0]):
                continue
            state = state_of_model(models[i, s])
            cost = truncated_cost(data, state, scale, least)
            if cost < least:
                least = cost
                chosen[i] = models[i, s]
    return chosen


@kernel
def refine_frames(
    models: Array,
    points: Array,
    rays: Array,
    tau: Array,
    by_ray: Array,
    mounts: Mounts,
    threshold: float,
    prior: PriorTerms,
) -> Array:
    """Local optimisation and final refinement of the Localizer on all points: states (h,24)."""
    states = np.full((len(models), STATE_SIZE), np.nan)
    noise = EXPECTED_NOISE * threshold
    for i in range(len(models)):
        if np.isnan(models[i, 0]):
            continue
        data = pack(points[i], rays[i], tau[i], by_ray, np.zeros(len(by_ray), np.int64), mounts)
        start = state_of_model(models[i]).reshape((1, STATE_SIZE))
        state, cost = optimize(start, np.zeros(1), data, 8.0 * threshold, threshold, prior, noise)
        if not np.isfinite(cost):
            continue
        errors = squared_errors(data, points.shape[1], state)
        gate = 4.0 * threshold * threshold
        inliers = weighted(data, np.where(errors < gate, 1.0, 0.0))
        state, _, _, _ = refine(inliers, state, 1e6, 0.0, prior, noise, 2, 10, 1e-6)
        states[i] = state
    return states


@kernel
def frame_errors(
    states: Array, points: Array, rays: Array, tau: Array, by_ray: Array, mounts: Mounts
) -> Array:
    """Reprojection errors (h,n) in pixels under the states (h,24) of the frames."""
    errors = np.empty(tau.shape)
    for i in range(len(states)):
        data = pack(points[i], rays[i], tau[i], by_ray, np.zeros(len(by_ray), np.int64), mounts)
        errors[i] = np.sqrt(squared_errors(data, tau.shape[1], states[i]))
    return errors


@kernel
def informations(
    states: Array, points: Array, rays: Array, tau: Array, by_ray: Array, mounts: Mounts
) -> Array:
    """Fisher information (h,12,12) of the states at a noise of one pixel, without acceleration."""
    found = np.empty((len(states), MOTION_PARAMETERS, MOTION_PARAMETERS))
    information, slope = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    for i in range(len(states)):
        data = pack(points[i], rays[i], tau[i], by_ray, np.zeros(len(by_ray), np.int64), mounts)
        normal_equations(data, states[i], 1e6, 0.0, 2, information, slope)
        found[i] = information[:MOTION_PARAMETERS, :MOTION_PARAMETERS]
    return found
