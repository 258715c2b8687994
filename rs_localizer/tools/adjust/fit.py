# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The estimator of many frames: a spline through all keypoints, and what the frames share.

The noise is not given: it is the scale of the errors, measured between the rounds, and so Tukey's
limit closes from the first guess to the noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.camera import Camera
from rs_localizer.tools.adjust.intrinsics import with_lens
from rs_localizer.tools.adjust.problem import Problem, fit_with_noise
from rs_localizer.tools.adjust.reprojection import LIMIT
from rs_localizer.tools.adjust.spline_kernels import CONTROL
from rs_localizer.tools.adjust.system import Factored
from rs_localizer.tools.adjust.variables import CameraView, Freedom, SplineKeypoints, Unknowns

# Richer models must lower the cost by this much per new parameter (Akaike).
_COST_PER_PARAMETER = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """An estimate with the covariance of its errors."""

    state: Unknowns
    camera: Camera
    deviation: float  # px, standard deviation of the noise of u and of v
    cost: float  # sum of the weighted squared errors in noise variances
    squared_errors: Array  # (n,) px^2, whitened
    inliers: BoolArray  # (n,)
    border_covariance: Array  # (b,b): readout time, lens, landmarks as far as they are free
    freedom: Freedom
    factored: Factored
    inflation: float  # of all covariances, for robust weights and used up freedoms

    @property
    def readout_time_deviation(self) -> float:
        """Standard deviation of the readout time (s); NaN where it was given."""
        free = len(self.border_covariance) and self.freedom.readout_time
        return float(np.sqrt(self.border_covariance[0, 0])) if free else np.nan

    def state_covariances(self, times: Array) -> Array:
        """Return covariances (m,12,12) at times (m,): rotation, position, body rate, velocity."""
        first, jacobians = self.state.spline.jacobians(times)
        inner = self.inflation * self.factored.local_covariances(first)
        covariances: Array = jacobians @ inner @ np.swapaxes(jacobians, 1, 2)
        return covariances


def fit(
    camera: Camera,
    observations: SplineKeypoints,
    start: Unknowns,
    freedom: Freedom,
    deviation: float | None = None,
) -> Fit:
    """Fit the most likely motion and shared numbers.

    Args:
        camera: lens model, size and scan direction; its readout time and numbers do not matter.
        observations: all keypoints; those not trusted take part once the motion is about right.
        start: first guess; its knots stay.
        freedom: the unknowns.
        deviation: px, of the noise about the first guess if that is good; otherwise the trusted
            keypoints have to lead to it.

    Raises:
        Undetermined: when the keypoints do not determine what is free.
    """
    return solve(Problem([CameraView(camera, observations, freedom)], start), start, deviation)


def solve(problem: Problem, start: Unknowns, deviation: float | None = None) -> Fit:
    """Solve :func:`fit` for one camera or a rig; the noise is that of the first camera.

    Raises:
        Undetermined: when the keypoints do not determine what is free.
    """
    state = start
    if deviation is None:
        trusted = problem.trusted(start)
        state, deviation = fit_with_noise(trusted, start, trusted.noise(start, np.inf))
    state, deviation = fit_with_noise(problem, state, deviation)
    return _finish(problem, state, deviation)


def cheaper(richer: Fit, plainer: Fit, parameters: float) -> bool:
    """Return True if this many more parameters are worth it, by the noise of the richer model."""
    limit = (LIMIT * richer.deviation) ** 2
    costs = [float(np.sum(fitted.squared_errors.clip(max=limit))) for fitted in (plainer, richer)]
    return (costs[0] - costs[1]) / richer.deviation**2 > _COST_PER_PARAMETER * parameters


def image_speeds(camera: Camera, observations: SplineKeypoints, state: Unknowns) -> Array:
    """Return the speeds (n,), px/s, of the keypoints in their images."""
    problem = Problem([CameraView(camera, observations, Freedom())], state)
    sights = problem.sights(state)[0]
    local, velocity = sights.local, sights.velocity
    by_ray = (velocity[:, :2] - velocity[:, 2:] * local[:, :2] / local[:, 2:]) / local[:, 2:]
    return np.asarray(np.linalg.norm(np.einsum("nij,nj->ni", sights.by_ray, by_ray), axis=1))


def _finish(problem: Problem, state: Unknowns, deviation: float) -> Fit:
    """Return the estimate with its covariances."""
    squared = problem.errors(state)
    system = problem.system(state, deviation)
    factored = Factored(system)
    inliers = squared < (LIMIT * deviation) ** 2
    used = problem.border + CONTROL * min(problem.images(inliers), len(state.spline.positions))
    inflation = inflation_of(squared[inliers], deviation, used)
    return Fit(
        state=state,
        camera=with_lens(replace(problem.camera, readout_time=abs(state.readout_time)), state.lens),
        deviation=deviation,
        cost=system.cost,
        squared_errors=squared,
        inliers=inliers,
        border_covariance=inflation * factored.border_covariance(),
        factored=factored,
        inflation=inflation,
        freedom=problem.freedom,
    )


def inflation_of(squared: Array, deviation: float, used: int) -> float:
    """Return the factor from the inverse normal matrix to the M-estimator's covariance.

    Huber's formula, ``E psi^2 / (E psi')^2``, where the matrix has the mean weight instead; and
    the freedoms that the motion used up.
    """
    weight = (1.0 - squared / (LIMIT * deviation) ** 2) ** 2
    psi_squared = np.mean(weight**2 * squared) / (2.0 * deviation**2)
    steep = steepness(squared, deviation)
    return float(psi_squared / np.mean(weight)) * steep**2 * left_over(len(squared), used)


def steepness(squared: Array, deviation: float) -> float:
    """Return the mean weight over ``E psi'``, the normal matrix's excess for Tukey's estimator."""
    share = squared / (LIMIT * deviation) ** 2
    weight = (1.0 - share) ** 2
    return float(np.mean(weight) / np.mean(weight - 2.0 * share * (1.0 - share)))


def left_over(keypoints: int, used: int) -> float:
    """Return the factor by which the noise's variance exceeds the mean square that is left."""
    return 2.0 * keypoints / max(2.0 * keypoints - used, 1.0)
