# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How much less is known because errors of keypoints that follow each other are correlated.

The corners of a marker, or the features of a surface, look nearly the same from image to image, and
so do their errors: a hundred of them say less than a hundred independent ones. Errors of a second
are taken together (cluster-robust covariance: Liang and Zeger, *Longitudinal data analysis using
generalized linear models*, Biometrika 1986), by what they pull at all that is estimated. As one
factor: a recording has too few seconds to tell one for each number.

Of independent errors, what a second pulls has the expectation ``tr B - tr B^2``, where ``B`` is the
share of all information that comes from it: what was estimated fits its own errors, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.tools.adjust.fit import Fit, steepness
from rs_localizer.tools.adjust.problem import Problem

SECONDS = 1.0
"""Errors farther apart than this are taken for independent."""
# A prior for the inflation: this many numbers that independent errors explain. What few seconds
# show may be chance.
_DOUBT = 4.0
# A second that tells less than this part of a number says nothing of it.
_LEAST_TOLD = 1e-3


@dataclass(frozen=True, slots=True)
class Pull:
    """Pull of errors at what is estimated, in its own covariance, all seconds together."""

    measured: float
    expected: float  # of independent errors of the noise that the covariance stands for

    def inflation(self, independent: float) -> float:
        """Return the factor of the covariance, unless independent errors explain it."""
        share = (self.measured + _DOUBT * independent) / (self.expected + _DOUBT)
        return max(share, independent)


def cluster_robust(problem: Problem, fitted: Fit) -> Fit:
    """Return the estimate with covariances as large as its own errors show.

    Args:
        problem: the problem whose minimum is given, with the same freedom and without delays of
            images.
    """
    of_errors = steepness(fitted.squared_errors[fitted.inliers], fitted.deviation) ** 2
    pull = _pull(problem, fitted)
    inflation = Pull(of_errors * pull.measured, pull.expected).inflation(fitted.inflation)
    return replace(
        fitted,
        border_covariance=fitted.border_covariance * (inflation / fitted.inflation),
        inflation=inflation,
    )


def _pull(problem: Problem, fitted: Fit) -> Pull:
    """Return pulls in units in which the border has covariance 1, and the controls follow it."""
    covariance = fitted.factored.border_covariance()
    unit = np.eye(problem.groups.kept, problem.border, -problem.groups.motion)
    following = fitted.factored.kept(unit) @ np.linalg.inv(np.linalg.cholesky(covariance)).T
    total, expected = 0.0, 0.0
    every = problem.keypoint_rows(fitted.state, fitted.deviation)
    for rows, view in zip(every, problem.views, strict=True):
        seconds = np.floor(view.observations.times / SECONDS)  # they rise
        starts = np.flatnonzero(np.diff(seconds, prepend=-np.inf)).tolist()
        for first, end in pairwise([*starts, len(seconds)]):
            own = rows.matrix(slice(first, end), len(following)) @ following
            total += float(np.sum((own.T @ rows.errors[first:end].ravel()) ** 2))
            share = own.T @ own if own.shape[0] > own.shape[1] else own @ own.T
            expected += float(np.trace(share) - np.sum(share**2))
    return Pull(total, expected)


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
    own = np.concatenate([rows.matrix(slice(None), len(following)) @ following for rows in every])
    own, errors = own.reshape(-1, 2), np.concatenate([rows.errors for rows in every])
    times = np.concatenate([view.observations.times for view in problem.views])
    second = np.unique(np.floor(times / SECONDS), return_inverse=True)[1]
    pulls, shares = (np.bincount(second, np.sum(own * of, axis=1)) for of in (errors, own))
    told = shares > _LEAST_TOLD
    of_errors = steepness(fitted.squared_errors[fitted.inliers], fitted.deviation)
    steps = -of_errors * pulls[told] / shares[told]
    return steps, np.sqrt(fitted.inflation / shares[told])


def pull_at_landmarks(rows: Array, landmarks: IntArray, times: Array, held: Array) -> Pull:
    """Return the pull of errors at landmarks for a given motion.

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
    return Pull(
        float(np.einsum("ki,kij,kj->", pulls, inverse, pulls)),
        float(np.einsum("kii->", shares) - np.einsum("kij,kji->", shares, shares)),
    )
