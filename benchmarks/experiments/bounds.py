# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The Cramer-Rao bound: no unbiased estimate of a motion is better than this."""

from __future__ import annotations

import numpy as np

from benchmarks.experiments.kernels import informations
from benchmarks.experiments.methods import states, view_arguments
from benchmarks.experiments.trials import Trials
from rs_localizer.core.arrays import Array


def median_bound(trials: Trials, points: int, noise: float, seed: int) -> Array:
    """Medians (2,) of the orientation (deg) and relative position error of the bound.

    Errors are drawn from the normal distribution whose covariance is the inverse Fisher
    information of the first so many points at the true motion.

    Args:
        noise: px.
    """
    world, rays, tau, by_ray, mounts = view_arguments(trials)
    information = informations(
        states(trials.truth), _first(world, points), _first(rays, points), _first(tau, points),
        by_ray[:points], mounts,
    )  # fmt: skip
    scale = 1.0 / np.sqrt(np.einsum("hii->hi", information))
    scaled = information * scale[:, :, None] * scale[:, None, :]
    values, vectors = np.linalg.eigh(scaled)
    half = scale[:, :, None] * vectors / np.sqrt(np.maximum(values, 1e-15))[:, None, :]
    draws = np.random.default_rng([seed, 2]).normal(size=(len(trials), half.shape[2]))
    errors = noise * np.einsum("hij,hj->hi", half, draws)
    distance = np.linalg.norm(trials.truth.position, axis=1)
    return np.array(
        [
            np.median(np.degrees(np.linalg.norm(errors[:, 0:3], axis=1))),
            np.median(np.linalg.norm(errors[:, 3:6], axis=1) / distance),
        ]
    )


def _first(values: Array, points: int) -> Array:
    return np.ascontiguousarray(values[:, :points])
