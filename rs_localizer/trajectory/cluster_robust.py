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

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.simd.jit import kernel
from rs_localizer.trajectory.fit import Fit, steepness
from rs_localizer.trajectory.normal_kernels import border_of
from rs_localizer.trajectory.problem import RigProblem
from rs_localizer.trajectory.sight_kernels import Curve, Sights, Terms, differentiate, make_row
from rs_localizer.trajectory.spline_kernels import CONTROL, LOCAL


@kernel
def border_rows(
    curve: Curve, sights: Sights, terms: Terms, places: IntArray, lifted: Array, first: int,
    out: Array,
) -> None:  # fmt: skip
    """Fill the rows of as many keypoints as there is room for; zeros for those that do not count.

    Args:
        places: (c,) of the camera's own columns in the border.
        lifted: (6 n, b) H^-1 C of the bordered system: how the controls follow the border.
        out: (k,2,b + 1) derivatives by the border, the controls following, and the error.
    """
    row = make_row(sights, terms)
    shared = lifted.shape[1]
    most = row.by_shared.shape[1] + 6
    columns, border = np.empty(most, np.int64), np.empty((2, most))
    out[:] = 0.0
    for k in range(len(out)):
        n = first + k
        weight, _ = differentiate(curve, sights, terms, n, row)
        if weight == 0.0:
            continue
        scale, base = np.sqrt(weight), CONTROL * sights.first[n]
        count = border_of(sights, terms, n, row, columns, border)
        for r in range(2):
            mine = out[k, r]
            mine[shared] = scale * row.error[r]
            for j in range(count):
                mine[places[columns[j]]] += scale * border[r, j]
            for a in range(LOCAL):
                x = scale * row.by_controls[r, a]
                for j in range(shared):
                    mine[j] -= x * lifted[base + a, j]


SECONDS = 1.0
"""Errors farther apart than this are taken for independent."""
# As if so many numbers had been found known as well as independent errors let them: what few
# seconds say is chance.
_DOUBT = 4.0


@dataclass(frozen=True, slots=True)
class Pull:
    """What errors pull at what is estimated, in its own covariance, all seconds together."""

    measured: float
    expected: float  # of independent errors of the noise that the covariance stands for

    def inflation(self, independent: float) -> float:
        """Of the covariance, if it would be so large for independent errors."""
        share = (self.measured + _DOUBT * independent) / (self.expected + _DOUBT)
        return max(share, independent)


def cluster_robust(problem: RigProblem, fitted: Fit) -> Fit:
    """The estimate with covariances as large as its own errors show.

    Args:
        problem: whose minimum it is, with the same freedom and without delays of images.
    """
    of_errors = steepness(fitted.squared_errors[fitted.inliers], fitted.deviation) ** 2
    pull = _pull(problem, fitted)
    inflation = Pull(of_errors * pull.measured, pull.expected).inflation(fitted.inflation)
    return replace(
        fitted,
        border_covariance=fitted.border_covariance * (inflation / fitted.inflation),
        inflation=inflation,
    )


def _pull(problem: RigProblem, fitted: Fit) -> Pull:
    lifted = fitted.factored.lifted
    whitening = np.linalg.cholesky(fitted.border_covariance / fitted.inflation)
    total, expected = 0.0, 0.0
    for curve, sights, terms, places, times in _parts(problem, fitted):
        for first, end in _seconds(times):
            rows = np.empty((end - first, 2, lifted.shape[1] + 1))
            border_rows(curve, sights, terms, places, lifted, first, rows)
            own = rows[..., :-1].reshape(2 * len(rows), -1) @ whitening
            total += float(np.sum((own.T @ rows[..., -1].ravel()) ** 2))
            share = own.T @ own if own.shape[0] > own.shape[1] else own @ own.T
            expected += float(np.trace(share) - np.sum(share**2))
    return Pull(total, expected)


def _parts(
    problem: RigProblem, fitted: Fit
) -> Iterator[tuple[Curve, Sights, Terms, IntArray, Array]]:
    """Parts of each camera's keypoints, and their times (n,)."""
    states = problem.states(fitted.state)
    for camera, state, ratio, places in zip(
        problem.cameras, states, problem.ratios, problem.columns, strict=True
    ):
        curve, parts = camera.look(state)
        terms = camera.terms(state, fitted.deviation * float(ratio))
        ends = np.cumsum([len(sights.first) for sights in parts])[:-1]
        for sights, times in zip(parts, np.split(camera.observations.times, ends), strict=True):
            yield curve, sights, terms, places, times


def _seconds(times: Array) -> list[tuple[int, int]]:
    """First and end of the keypoints of each second, at rising times (n,)."""
    starts = np.flatnonzero(np.diff(np.floor(times / SECONDS), prepend=-np.inf))
    return list(zip(starts.tolist(), [*starts[1:].tolist(), len(times)], strict=True))


def pull_at_landmarks(rows: Array, landmarks: IntArray, times: Array, held: Array) -> Pull:
    """What errors pull at landmarks, the motion taken for given.

    Args:
        rows: (n,2,4) whitened derivatives by the landmark, and the error.
        landmarks: (n,) numbers of the landmarks.
        times: (n,) s.
        held: (p,) 1/m^2, of what is known of the landmarks beforehand.
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
