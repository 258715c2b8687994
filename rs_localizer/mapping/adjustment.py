"""Map and motion together: the cost, its normal equations and the landmarks' covariances."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.mapping.elimination import Rows, record
from rs_localizer.mapping.gauge import Floating
from rs_localizer.mapping.reduced import MapNormal, Reduced
from rs_localizer.trajectory.model import Freedom, Observations, State
from rs_localizer.trajectory.problem import Problem
from rs_localizer.trajectory.spline_kernels import LOCAL


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
