# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The search for the motion of an image: a global-shutter start, then the solver's hypotheses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rs_localizer.config import LocalizerConfig, RefinementKind
from rs_localizer.core.arrays import Array, Array1, Array2, BoolArray
from rs_localizer.core.state import STATE_SIZE, rotation_of
from rs_localizer.estimation.observations import Observed
from rs_localizer.estimation.plane import leaning_less
from rs_localizer.estimation.prior import PriorTerms, held_terms
from rs_localizer.estimation.ransac import (
    NOTHING,
    Candidate,
    Draws,
    Hypotheses,
    descend,
    optimize,
    pools_of,
    search,
)
from rs_localizer.estimation.refine import EXPECTED_NOISE
from rs_localizer.estimation.residuals import squared_errors
from rs_localizer.native import entry
from rs_localizer.solvers.table import Solver

# A global-shutter pose under motion misses the points of the first and last rows by a good part
# of the image; it only has to be right to some degrees. In focal lengths.
GLOBAL_SHUTTER_SCALE = 0.05
_POOL_SCALE = 0.12
# Minimal models are scored at this multiple of the inlier threshold: noise makes a six-point
# model miss the other inliers. At 4 or 3 times a model between two groups of points that are four
# thresholds apart was the best one in 13 or 6 of 80 frames.
SCORE_SCALE = 2.0
_GLOBAL_SHUTTER_BLOCK = 48
_BLOCK = 64
# A start, or a motion of left-out points, draws at most so many: of a fast camera one pose explains
# so few points that the search would not end, and 70 to 80 % of outliers need no more (239 frames).
_FEW_SAMPLES = 384
# A start leads nowhere if its own motion fits less than this part of the points near it.
_AGREEING = 0.5
# Samples of left-out points: enough to find three inliers if two fifths are inliers.
_START_SAMPLES = 96


class MotionSearch:
    """Finds the motion that most points of a frame agree on."""

    def __init__(
        self, focal_length: float, config: LocalizerConfig, solver: Solver, start: Solver
    ) -> None:
        self._config = config
        self._solver = solver
        self._start = start  # a global-shutter solver
        self._near = _POOL_SCALE * focal_length
        threshold = config.inlier_threshold
        self._noise = EXPECTED_NOISE * threshold
        self._optimizes = config.refinement != RefinementKind.NONE
        expected = self._noise, config.solver_iterations
        wide = max(GLOBAL_SHUTTER_SCALE * focal_length, threshold)
        self._rough = wide
        score = (SCORE_SCALE if self._optimizes else 1.0) * threshold
        scales = (wide, wide) if solver.rolling_shutter else (score, threshold)
        self._starts = Hypotheses(
            start, _GLOBAL_SHUTTER_BLOCK, *scales, *expected, optimized=self._optimizes
        )
        self._motions = Hypotheses(
            solver, _BLOCK, score, threshold, *expected, optimized=self._optimizes
        )

    def find(self, observed: Observed) -> Candidate:
        """Find the motion from a global-shutter start, or nothing."""
        most = self._config.max_iterations
        if not self._solver.rolling_shutter:
            return self._global_shutter(observed, most)
        start = self._global_shutter(observed, min(_FEW_SAMPLES, most))
        return self._motion(observed, start, most)

    def among(self, observed: Observed, chosen: BoolArray, least: int) -> Candidate:
        """Find the motion of these points alone, if more than so many roughly share a pose."""
        part = replace(
            observed, observations=observed.observations.only(np.flatnonzero(chosen)),
            ranking=observed.ranking[:0],
        )  # fmt: skip
        start = self.rough(part)
        if (
            not start.found
            or np.count_nonzero(part.observations.within(start.state, self._rough)) <= least
        ):
            return NOTHING
        return self._motion(part, start, _FEW_SAMPLES)

    def rough(self, observed: Observed) -> Candidate:
        """Find a pose that fits all rows of enough points roughly, or nothing."""
        return self._global_shutter(observed, _START_SAMPLES)

    def _global_shutter(self, observed: Observed, most: int) -> Candidate:
        """Find a pose that fits all rows roughly, with a wide threshold."""
        observations = observed.observations
        pools = pools_of(
            observations.camera, observations.tau, len(observations.mounts.axes),
            self._start.sample_size, np.ones(observations.count, np.bool_), observed.ranking, False,
        )  # fmt: skip
        draws = Draws(np.eye(3), pools, self._config.confidence, most, observed.random)
        return search(observations, self._starts, held_terms(), draws, NOTHING)

    def _motion(self, observed: Observed, start: Candidate, most: int) -> Candidate:
        """Find the motion that most points agree on, from the solver's hypotheses."""
        if not start.found:
            return start
        observations, threshold = observed.observations, self._config.inlier_threshold
        if self._optimizes:
            near, state, cost, agreeing = _from_start(
                observations.packed, observations.count, start.state, self._near, threshold,
                observed.terms, self._noise,
            )  # fmt: skip
            # The global-shutter pose is a hypothesis, too: at rest it is the best one.
            first = Candidate(state, cost)
            if agreeing < _AGREEING * np.count_nonzero(near):
                first = self._facing(observed, start, near, first)
        else:
            near, first = observations.within(start.state, self._near), NOTHING
        pools = pools_of(
            observations.camera, observations.tau, len(observations.mounts.axes),
            self._solver.sample_size, near, observed.ranking, True,
        )  # fmt: skip
        draws = Draws(
            rotation_of(start.state), pools, self._config.confidence, most, observed.random
        )
        return search(observations, self._motions, observed.terms, draws, first)

    def _facing(
        self, observed: Observed, start: Candidate, near: BoolArray, found: Candidate
    ) -> Candidate:
        """Find a motion before a plane that faces the camera, if the start led nowhere.

        Turning and moving stretch and shear the image of a plane, so that the global-shutter pose
        leans by tens of degrees; from there the way leads to other leans, and samples of six noisy
        points tell leaning from moving no better.
        """
        observations = observed.observations
        leans, towards = leaning_less(observations.points, near, start.state, 1.0)
        if not leans:
            return found
        state, cost = descend(
            observations.packed, towards, self._near, self._config.inlier_threshold,
            observed.terms, self._noise,
        )  # fmt: skip
        return Candidate(state, cost) if cost < found.cost else found

    def optimize(
        self, observed: Observed, state: Array, first_scale: float, terms: PriorTerms
    ) -> Candidate:
        """Optimize one state locally, down to the inlier threshold."""
        optimized, cost = optimize(
            state[None], np.zeros(1), observed.observations.packed, first_scale,
            self._config.inlier_threshold, terms, self._noise,
        )  # fmt: skip
        return Candidate(optimized, cost)


@entry
def _from_start(
    data: Array2, count: int, start: Array1, wide: float, threshold: float, prior: PriorTerms,
    noise: float,
) -> tuple[BoolArray, Array, float, int]:  # fmt: skip
    """Return which points may belong to a motion with this global-shutter pose, and how many agree
    with it; between them the motion and its cost, by local optimization.
    """
    near, agreeing = squared_errors(data, count, start) < wide * wide, 0
    states = start.copy().reshape(1, STATE_SIZE)
    state, cost = optimize(states, np.zeros(1), data, wide, threshold, prior, noise)
    if cost < np.inf:
        errors = squared_errors(data, count, state)
        agreeing = int(np.count_nonzero(near & (errors < threshold * threshold)))
    return near, state, cost, agreeing
