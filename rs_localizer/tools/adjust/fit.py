# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The estimator of many frames: a spline through all keypoints, and what the frames share.

The noise is not given: it is the scale of the errors, measured between the rounds, and so Tukey's
limit closes from the first guess to the noise.

Errors of keypoints that follow each other are correlated. The corners of a marker, or the features
of a surface, look nearly the same from image to image, and so do their errors: a hundred of them
say less than a hundred independent ones. Errors of a second are taken together (cluster-robust
covariance: Liang and Zeger, *Longitudinal data analysis using generalized linear models*,
Biometrika 1986), by what they pull at all that is estimated. As one factor: a recording has too few
seconds to tell one for each number. Of independent errors, what a second pulls has the expectation
``tr B - tr B^2``, where ``B`` is the share of all information that comes from it: what was
estimated fits its own errors, too.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
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
        return np.asarray(jacobians @ inner @ np.swapaxes(jacobians, 1, 2))


def fit(
    observations: SplineKeypoints, start: Unknowns, freedom: Freedom, deviation: float | None = None
) -> Fit:
    """Fit the most likely motion and shared numbers.

    Args:
        observations: all keypoints; those not trusted take part once the motion is about right. Of
            their camera, readout time and numbers do not matter.
        start: first guess; its knots stay.
        freedom: the unknowns.
        deviation: px, of the noise about the first guess if that is good; otherwise the trusted
            keypoints have to lead to it.

    Raises:
        Undetermined: when the keypoints do not determine what is free.
    """
    return solve(Problem([CameraView(observations, freedom)], start), start, deviation)


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


def image_speeds(observations: SplineKeypoints, state: Unknowns) -> Array:
    """Return the speeds (n,), px/s, of the keypoints in their images."""
    problem = Problem([CameraView(observations, Freedom())], state)
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
        deviation=deviation, cost=system.cost, squared_errors=squared, inliers=inliers,
        border_covariance=inflation * factored.border_covariance(), factored=factored,
        inflation=inflation, freedom=problem.freedom,
    )  # fmt: skip


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


SECONDS = 1.0
"""Errors farther apart than this are taken for independent."""
# A prior for the inflation: this many numbers that independent errors explain. What few seconds
# show may be chance.
_DOUBT = 4.0
# A second that tells less than this part of a number says nothing of it.
_LEAST_TOLD = 1e-3


def inflation_by_pull(measured: float, expected: float, independent: float) -> float:
    """Return the factor of a covariance, unless independent errors explain it.

    Args:
        measured: pull of errors at what is estimated, in its own covariance, all seconds together.
        expected: pull of independent errors of the noise that the covariance stands for.
        independent: factor for independent errors.
    """
    return max((measured + _DOUBT * independent) / (expected + _DOUBT), independent)


def cluster_robust(problem: Problem, fitted: Fit) -> Fit:
    """Return the estimate with covariances as large as its own errors show.

    Args:
        problem: the problem whose minimum is given, with the same freedom and without delays of
            images.
    """
    of_errors = steepness(fitted.squared_errors[fitted.inliers], fitted.deviation) ** 2
    measured, expected = _pull(problem, fitted)
    inflation = inflation_by_pull(of_errors * measured, expected, fitted.inflation)
    return replace(
        fitted,
        border_covariance=fitted.border_covariance * (inflation / fitted.inflation),
        inflation=inflation,
    )


def _pull(problem: Problem, fitted: Fit) -> tuple[float, float]:
    """Return the measured and the expected pull, in units in which the border has covariance 1."""
    covariance = fitted.factored.border_covariance()
    unit = np.eye(problem.groups.kept, problem.border, -problem.groups.motion)
    following = fitted.factored.kept(unit) @ np.linalg.inv(np.linalg.cholesky(covariance)).T
    total, expected = 0.0, 0.0
    every = problem.keypoint_rows(fitted.state, fitted.deviation)
    for rows, view in zip(every, problem.views, strict=True):
        seconds = np.floor(view.observations.times / SECONDS)  # they rise
        starts = np.flatnonzero(np.diff(seconds, prepend=-np.inf)).tolist()
        for first, end in pairwise([*starts, len(seconds)]):
            own = rows.matrix(len(following), slice(first, end)) @ following
            total += float(np.sum((own.T @ rows.errors[first:end].ravel()) ** 2))
            share = own.T @ own if own.shape[0] > own.shape[1] else own @ own.T
            expected += float(np.trace(share) - np.sum(share**2))
    return total, expected


def by_seconds(problem: Problem, fitted: Fit, number: int) -> tuple[Array, Array]:
    """Return how far each second alone would move one number of the border, the rest following.

    Of one number few seconds say more than one factor of all: a motion that the spline does not
    follow pulls at the readout time, and hardly at places.

    Args:
        problem: whose minimum it is.

    Returns:
        and the deviations of these steps (s,), both in those of the number for noise of 1.
    """
    at = problem.groups.motion + number
    following = fitted.factored.kept(np.eye(problem.groups.kept, 1, -at))
    following /= np.sqrt(following[at])
    every = problem.keypoint_rows(fitted.state, fitted.deviation)
    own = np.concatenate([rows.matrix(len(following)) @ following for rows in every])
    own, errors = own.reshape(-1, 2), np.concatenate([rows.errors for rows in every])
    times = np.concatenate([view.observations.times for view in problem.views])
    second = np.unique(np.floor(times / SECONDS), return_inverse=True)[1]
    pulls, shares = (np.bincount(second, np.sum(own * of, axis=1)) for of in (errors, own))
    told = shares > _LEAST_TOLD
    of_errors = steepness(fitted.squared_errors[fitted.inliers], fitted.deviation)
    steps = -of_errors * pulls[told] / shares[told]
    return steps, np.sqrt(fitted.inflation / shares[told])


def pull_at_landmarks(
    rows: Array, landmarks: IntArray, times: Array, held: Array
) -> tuple[float, float]:
    """Return the measured and the expected pull of errors at landmarks, for a given motion.

    Args:
        rows: (n,2,4) whitened derivatives by the landmark, and the error.
        landmarks: (n,) numbers of the landmarks.
        times: (n,) s.
        held: (p,) 1/m^2, prior information on the landmarks.
    """
    seconds = np.floor(times / SECONDS)
    order = np.lexsort((seconds, landmarks))
    own, errors = rows[order, :, :3], rows[order, :, 3]
    of, at = landmarks[order], seconds[order]
    starts = np.flatnonzero((np.diff(of, prepend=-1) != 0) | (np.diff(at, prepend=-np.inf) != 0))
    information = np.add.reduceat(np.einsum("nri,nrj->nij", own, own), starts)
    pulls = np.add.reduceat(np.einsum("nri,nr->ni", own, errors), starts)
    every = held[:, None, None] * np.eye(3)
    np.add.at(every, of[starts], information)
    inverse = np.linalg.inv(every[of[starts]])
    shares = inverse @ information
    measured = float(np.einsum("ki,kij,kj->", pulls, inverse, pulls))
    return measured, float(np.einsum("kii->", shares) - np.einsum("kij,kji->", shares, shares))
