# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Map and motion together: the cost, its normal equations, their solution, and what is known then.

Landmarks are eliminated, the rest is dense: a landmark that is seen at distant times ties all
controls of these times together, so that the reduced system has no band. It is factored as a whole
(LAPACK): 300 images on their own have 7200 unknowns, which is a few seconds and 0.4 GB.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve
from scipy.linalg.lapack import dpotrf, dpotri

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.mapping.elimination import (
    Rows,
    covariances,
    eliminate,
    lift,
    lower,
    record,
    slopes,
)
from rs_localizer.mapping.gauge import Floating, as_held, generators, laid_over
from rs_localizer.trajectory.banded import Undetermined
from rs_localizer.trajectory.model import Freedom, Observations, State
from rs_localizer.trajectory.normal_kernels import Normal
from rs_localizer.trajectory.problem import Problem
from rs_localizer.trajectory.spline import Spline
from rs_localizer.trajectory.spline_kernels import LOCAL

_WORKERS = 2


@dataclass(frozen=True, slots=True, eq=False)
class MapNormal:
    """Normal equations of motion, shared numbers and landmarks."""

    motion: Normal  # with the map as it is
    rows: Rows
    held: Array  # (N,7) whitened directions in which the whole would float
    held_error: Array  # (7,)


class Reduced:
    """A factored system.

    Args:
        normal: the normal equations.
        damping: the diagonal is multiplied by 1 + this (Levenberg and Marquardt).

    Raises:
        Undetermined: when the system is not positive definite.
    """

    def __init__(self, normal: MapNormal, damping: float = 0.0) -> None:
        self._rows = normal.rows._replace(damping=damping)
        self._controls = len(normal.motion.slope)
        self._slope = np.concatenate([normal.motion.slope, normal.motion.border_slope])
        self._slope += normal.held @ normal.held_error
        system, sequence = _dense(normal.motion, damping), _sequence(self._rows)
        with ThreadPoolExecutor(_WORKERS) as workers:
            for _ in workers.map(
                lambda part: eliminate(self._rows, sequence, part, _WORKERS, system),
                range(_WORKERS),
            ):
                pass
        system += normal.held @ normal.held.T
        # LAPACK counts along columns: the lower triangle is its upper one.
        self._factor, failed = dpotrf(system.T, lower=0, overwrite_a=1, clean=0)
        if failed:
            raise Undetermined("the images do not determine map and motion")

    @property
    def size(self) -> int:
        """Number N of controls' and shared numbers."""
        return len(self._slope)

    def solve(self, right: Array, landmarks: Array) -> tuple[Array, Array]:
        """Solutions (N,m) and (p,3,m) for right sides of these shapes."""
        reduced, own = np.zeros_like(right), landmarks.copy()
        lift(self._rows, landmarks, reduced)
        reduced = cho_solve((self._factor, False), right - reduced, check_finite=False)
        lower(self._rows, reduced, own)
        return reduced, own

    def step(self) -> tuple[Array, Array, Array]:
        """The step (6 n,) of the controls, (s,) of the shared numbers, (p,3) of the landmarks."""
        own = np.empty((len(self._rows.precisions), 3))
        slopes(self._rows, own)
        reduced, landmarks = self.solve(-self._slope[:, None], -own[:, :, None])
        return reduced[: self._controls, 0], reduced[self._controls :, 0], landmarks[:, :, 0]

    def covariances(self) -> tuple[Array, Array]:
        """Of each landmark (p,3,3) and of the shared numbers (s,s); the factors are used up."""
        inverse, failed = dpotri(self._factor, lower=0, overwrite_c=1)
        if failed:
            raise Undetermined("the images do not determine map and motion")
        inverse, parts = inverse.T, np.array_split(_sequence(self._rows), _WORKERS)
        out = np.empty((len(self._rows.precisions), 3, 3))
        with ThreadPoolExecutor(_WORKERS) as workers:
            for _ in workers.map(lambda part: covariances(self._rows, part, inverse, out), parts):
                pass
        shared = np.tril(inverse[self._controls :, self._controls :])
        return out, shared + np.tril(shared, -1).T


def _sequence(rows: Rows) -> IntArray:
    """The landmarks (p,) by the first images that see them."""
    last = len(rows.order)
    seen = np.minimum(rows.starts[:-1], max(last - 1, 0))
    firsts = rows.first[rows.order[seen]] if last else rows.starts[:-1]
    return np.asarray(np.argsort(firsts, kind="stable"), np.int64)


def _dense(motion: Normal, damping: float) -> Array:
    """Lower triangle (N,N) of controls and shared numbers."""
    count = motion.band.shape[1]
    system = np.zeros((count + len(motion.corner),) * 2)
    for d in range(min(len(motion.band), count)):
        columns = np.arange(count - d)
        system[columns + d, columns] = motion.band[d, : count - d]
    system[count:, :count] = motion.cross.T
    system[count:, count:] = np.tril(motion.corner)
    diagonal = np.arange(len(system))
    system[diagonal, diagonal] *= 1.0 + damping
    return system


class MapStep(NamedTuple):
    """Of all that is free."""

    controls: Array  # (6 n,)
    shared: Array  # (s,)
    landmarks: Array  # (p,3) m


class MapProblem:
    """The cost of a state with all landmarks free.

    Args:
        camera: lens, size and scan direction.
        observations: keypoints, and the landmarks as they are known beforehand.
        start: first guess.
        freedom: what else is free; its deviation of landmarks does not matter.
        deviations: (p,) m, of the landmarks as they are known beforehand.
        floating: nothing holds the whole but its start.
    """

    def __init__(
        self, camera: Camera, observations: Observations, start: State, freedom: Freedom,
        deviations: Array, floating: bool,
    ) -> None:  # fmt: skip
        # The motion's part: what it would be if the map were known.
        self.motion = Problem(camera, observations, start, replace(freedom, landmarks=0.0))
        self.floating = floating
        self._whole = Floating(start.spline, self.motion.border) if floating else None
        self._precisions = deviations**-2.0

    @property
    def observations(self) -> Observations:
        return self.motion.observations

    def errors(self, state: State) -> Array:
        """Squared whitened errors (n,), px^2."""
        return self.motion.errors(state)

    def noise(self, state: State, deviation: float) -> float:
        """Standard deviation of the noise, px."""
        return self.motion.noise(state, deviation)

    def normal(self, state: State, deviation: float) -> tuple[float, MapNormal]:
        """Cost and normal equations."""
        cost, motion = self.motion.normal(state, deviation)
        rows = self._rows(state, deviation)
        cost += float(np.sum(rows.precisions[:, None] * rows.offsets**2))
        held, error = np.zeros((len(motion.slope) + self.motion.border, 0)), np.zeros(0)
        if self._whole is not None:
            held, error = self._whole.terms(state.spline)
            cost += float(error @ error)
        return cost, MapNormal(motion, rows, held, error)

    def _rows(self, state: State, deviation: float) -> Rows:
        curve, parts = self.motion.look(state)
        terms, seen = self.motion.terms(state, deviation), self.observations
        values = np.empty((len(seen.points), 2, LOCAL + self.motion.border + 4))
        ends = np.cumsum([len(sights.first) for sights in parts])
        self.motion.each(
            lambda sights, part: record(curve, sights, terms, part),
            parts,
            np.split(values, ends[:-1]),
        )
        first = np.concatenate([sights.first for sights in parts])
        count = len(state.landmarks)
        return Rows(
            values,
            first,
            np.lexsort((first, seen.points)),
            np.concatenate([[0], np.cumsum(np.bincount(seen.points, minlength=count))]),
            self._precisions,
            state.landmarks - seen.landmarks,
            len(state.spline.positions),
            0.0,
        )

    def step(self, normal: MapNormal, damping: float) -> MapStep:
        """Levenberg's; raises Undetermined when the equations are not positive definite."""
        return MapStep(*Reduced(normal, damping).step())

    def moved(self, state: State, normal: MapNormal, step: MapStep) -> State:
        """The state after a step."""
        moved = self.motion.moved(state, normal.motion, (step.controls, step.shared))
        return replace(moved, landmarks=state.landmarks + step.landmarks)


def sights_of(observations: Observations, inliers: BoolArray) -> tuple[IntArray, IntArray]:
    """How many keypoints (p,) and how many images (p,) show each landmark."""
    count = len(observations.landmarks)
    sights = np.bincount(observations.points[inliers], minlength=count)
    pairs = np.unique(
        np.column_stack([observations.points[inliers], observations.frames[inliers]]), axis=0
    )
    return sights, np.bincount(pairs[:, 0], minlength=count)


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Map and motion in the frame of the map as it was given."""

    points: Array  # (p,3) m
    covariances: Array  # (p,3,3) m^2, inverse of the normal matrix
    shared: Array  # (s,s) covariance of readout time and lens, likewise
    spline: Spline


def apply_similarity(
    problem: MapProblem, state: State, deviation: float, usable: BoolArray
) -> Placed:
    """Lay the map over the given one, unless landmarks of known place hold it.

    Args:
        problem: whose minimum the state is.
        state: map and motion.
        deviation: px, of the noise.
        usable: (p,) which landmarks may hold the whole.

    Raises:
        Undetermined: when the images leave something open.
    """
    reduced = Reduced(problem.normal(state, deviation)[1])
    if not problem.floating:
        return Placed(state.landmarks, *reduced.covariances(), state.spline)
    given = problem.observations.landmarks
    whole, kept = laid_over(state.landmarks, given, usable)
    every = generators(state.landmarks, state.landmarks[kept].mean(axis=0))
    of_kept = np.where(kept[:, None, None], every, 0.0)
    spread = reduced.solve(np.zeros((reduced.size, 7)), of_kept)[1]
    covariances, shared = reduced.covariances()
    held = as_held(covariances, spread, every, of_kept)
    return Placed(
        whole(state.landmarks), whole.covariances(held), shared, whole.moved(state.spline)
    )
