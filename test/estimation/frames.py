# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of a box of points, made by the tests' own projection, and what is assumed of them."""

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.config import LocalizerConfig
from rs_localizer.core.camera import Camera
from rs_localizer.core.rig import Mounts, Rig
from rs_localizer.core.state import step_between
from rs_localizer.estimation.hypotheses import Posterior
from rs_localizer.estimation.points import Observations
from rs_localizer.estimation.prior import assumptions
from rs_localizer.estimation.robust import best_motion
from rs_localizer.solvers.table import find_solver

from .projection import gradient, jacobian_of, pixels_of, project, row_time, steady

READOUT = 0.03
CAMERA = Camera(640, 480, np.diag([590.0, 590.0, 1.0]), readout_time=READOUT)
PRIOR, ASSUMED = assumptions(READOUT, Rig.of(CAMERA), LocalizerConfig(), find_solver("r6p_vcwt"))
DIRECTION = "top_to_bottom"


def box(seed, speed, count=60, acceleration=0.0, rng=None):
    """A state (24,), and points (n,3) 4 m before the camera."""
    rotation = Rotation.random(random_state=seed).as_matrix()
    rng = np.random.default_rng(seed) if rng is None else rng
    state = np.concatenate(
        [rotation.ravel(), [0.0, 0.0, 4.0], speed * rng.normal(size=6),
         acceleration * rng.normal(size=6)]
    )  # fmt: skip
    return state, rng.uniform([-1.5, -1.2, -1.0], [1.5, 1.2, 1.0], (count, 3)) @ rotation


def observe(state, points, noise, seed, swing=steady, seen_as=None):
    """Observations of points, each seen by its own row, in a map that says ``seen_as``."""
    rays, _ = project(state, points, swing=swing)
    measured = pixels_of(rays) + noise * np.random.default_rng(seed).normal(size=rays.shape)
    for _ in range(20):  # Newton's method undoes the lens
        rays -= np.linalg.solve(jacobian_of(rays), (pixels_of(rays) - measured)[..., None])[..., 0]
    return Observations.of(
        points if seen_as is None else seen_as, rays, row_time(measured, DIRECTION),
        jacobian_of(rays), Mounts.one(gradient(DIRECTION)),
    )  # fmt: skip


def frame(seed, speed, noise, count=60, acceleration=0.0, **more):
    rng = np.random.default_rng(seed)
    state, points = box(seed, speed, count, acceleration, rng)
    return observe(state, points, noise, rng, **more), state


def changed(observations, points=None, gradient=None, rounded=0.0):
    """The observations of other points (n,3), with another gradient (2,) of the row times, or of
    points and rays that differ by a rounding.
    """
    points = observations.points if points is None else points
    return Observations.of(
        points * (1.0 + rounded), observations.rays * (1.0 - rounded), observations.tau,
        observations.by_ray, observations.mounts if gradient is None else Mounts.one(gradient),
    )  # fmt: skip


def fitted(observations, start, prior, threshold):
    return Posterior(*best_motion(observations.packed, len(observations), start, prior, threshold))


def distance(posterior, truth, parts):
    error = step_between(posterior.state, truth)[parts]
    return error @ np.linalg.solve(posterior.covariance[parts, parts], error)


def alike(found, expected, scale, **within):
    """Assert that vectors (n,) or matrices (n,n) are equal in units of deviations (n,)."""
    units = scale if np.ndim(found) == 1 else np.outer(scale, scale)
    np.testing.assert_allclose(found / units, expected / units, **within)


def agree(step, covariance, expected, own, **within):
    """Assert that a Gaussian has this mean (n,) and covariance (n,n), in its deviations."""
    deviations = np.sqrt(np.diag(own))
    alike(step, expected, deviations, **within)
    alike(covariance, own, deviations, **within)


def differences(function, size, h):
    """Derivative (...,size) of a function of a vector at zero, by central differences."""
    return np.stack([(function(e) - function(-e)) / (2 * h) for e in h * np.eye(size)], axis=-1)
