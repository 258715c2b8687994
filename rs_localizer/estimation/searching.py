# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The search for the motion of an image: a global-shutter start, then the solver's hypotheses."""

from __future__ import annotations

import numpy as np

from rs_localizer.config import LocalizerConfig
from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.state import at_rest, rotation_of
from rs_localizer.estimation.mirror import facing
from rs_localizer.estimation.observations import Observations, Observed
from rs_localizer.estimation.posterior import WIDEST_GATE
from rs_localizer.estimation.prior import PriorTerms, held_terms
from rs_localizer.estimation.ransac import (
    NOTHING,
    Candidate,
    Draws,
    Hypotheses,
    Pool,
    descend,
    optimize,
    search,
)
from rs_localizer.estimation.refine import EXPECTED_NOISE
from rs_localizer.solvers.table import Solver

# A global-shutter pose under motion misses the points of the first and last rows by a good part
# of the image; it only has to be right to some degrees. In focal lengths.
_GLOBAL_SHUTTER_SCALE = 0.05
_POOL_SCALE = 0.12
# Minimal models are scored at this multiple of the inlier threshold: noise makes a six-point
# model miss the other inliers by several times their own noise.
_SCORE_SCALE = 4.0
_GLOBAL_SHUTTER_BLOCK = 48
_BLOCK = 64
# Either search first draws at most so many: they do for all but the hardest frames, and what they
# find tells whether more are worth it.
_FIRST_SAMPLES = 384
# A global-shutter start near more than this part of a motion's inliers would lead to it again.
_SAME_GROUP = 0.5
# Enough to find three inliers among points of which two fifths are.
_SECOND_LOOK_SAMPLES = 96


class MotionSearch:
    """Finds the motion that most points of a frame agree on."""

    def __init__(
        self, focal_length: float, config: LocalizerConfig, solver: Solver, start: Solver
    ) -> None:
        self._config = config
        self._solver = solver
        self._start = start  # a global-shutter solver
        self._focal_length = focal_length
        threshold = config.inlier_threshold
        wide = max(_GLOBAL_SHUTTER_SCALE * self._focal_length, threshold)
        if not solver.rolling_shutter:
            scales = _SCORE_SCALE * threshold, threshold
        else:
            scales = wide, wide
        self._starts = self._hypotheses(start, _GLOBAL_SHUTTER_BLOCK, *scales)
        self._motions = self._hypotheses(solver, _BLOCK, _SCORE_SCALE * threshold, threshold)

    def find(self, observed: Observed) -> tuple[Candidate, Candidate]:
        """The global-shutter start and the motion found from it; the start may not be found."""
        everything = np.arange(observed.observations.count)
        most = self._config.max_iterations
        first = min(_FIRST_SAMPLES, most) if self._solver.rolling_shutter else most
        start = self._global_shutter(observed, everything, first)
        best = self._motion(observed, start, first)
        if first < most:
            start, best = self._go_on(observed, start, best)
        return self._largest_group(observed, start, best)

    def _go_on(
        self, observed: Observed, start: Candidate, best: Candidate
    ) -> tuple[Candidate, Candidate]:
        """The start and the motion after more samples, where the first ones may not be enough."""
        most = self._config.max_iterations
        if start.samples >= _FIRST_SAMPLES and self._missed(
            inliers := self._inliers(observed, best), start.samples
        ):
            later = self._global_shutter(observed, np.arange(len(inliers)), most, start)
            if not np.any(inliers) or np.mean(self._near(observed, later)[inliers]) < _SAME_GROUP:
                rival = self._motion(observed, later, most)
                if rival.cost < best.cost:
                    return later, rival
            elif later.cost < start.cost:
                start = later
        if best.samples >= _FIRST_SAMPLES:
            best = self._motion(observed, start, most, best)
        return start, best

    def _inliers(self, observed: Observed, best: Candidate) -> BoolArray:
        if not best.found:
            return np.zeros(observed.observations.count, dtype=np.bool_)
        return observed.observations.within(best.state, self._config.inlier_threshold)

    def _missed(self, inliers: BoolArray, samples: int) -> bool:
        """Whether every sample of the global-shutter start may have held an outlier.

        The motion tells, not the start: where the camera is fast, that explains but a part of the
        inliers.
        """
        share = float(np.mean(inliers))
        chance = (1.0 - share**self._start.sample_size) ** samples
        return chance > 1.0 - self._config.confidence

    def _largest_group(
        self, observed: Observed, start: Candidate, best: Candidate
    ) -> tuple[Candidate, Candidate]:
        """The start and the motion of another group of points, if it is the larger one.

        The search stays near its global-shutter start. Where that lies on a second moving object,
        the points that it leaves out may hold more inliers than it found.
        """
        if not best.found:
            return start, best
        others = np.flatnonzero(~self._near(observed, start))
        # At the widest gate of the final estimate, so that noise hides none of them.
        gate = WIDEST_GATE * self._config.inlier_threshold
        inliers = observed.observations.within(best.state, gate)
        if not self._solver.rolling_shutter or len(others) <= np.count_nonzero(inliers):
            return start, best
        second = self._global_shutter(observed, others, _SECOND_LOOK_SAMPLES)
        if not second.found or (
            np.count_nonzero(self._near(observed, second)[others]) <= np.count_nonzero(inliers)
        ):
            return start, best
        rival = self._motion(observed, second, self._config.max_iterations)
        return (second, rival) if rival.cost < best.cost else (start, best)

    def _near(self, observed: Observed, start: Candidate) -> BoolArray:
        """Which points may belong to a motion whose global-shutter pose this is."""
        return observed.observations.within(start.state, _POOL_SCALE * self._focal_length)

    def _global_shutter(
        self, observed: Observed, among: IntArray, most: int, before: Candidate = NOTHING
    ) -> Candidate:
        """A pose that fits all rows roughly, from some points and with a wide threshold."""
        pools = _pools(observed, among)
        draws = Draws([np.eye(3)], pools, self._config.confidence, most, observed.random)
        return search(observed.observations, self._starts, held_terms(), draws, before)

    def _motion(
        self, observed: Observed, start: Candidate, most: int, before: Candidate | None = None
    ) -> Candidate:
        """The motion that most points agree on, from the solver's hypotheses."""
        if not self._solver.rolling_shutter or not start.found:
            return start
        near = np.flatnonzero(self._near(observed, start))
        # The global-shutter pose is a hypothesis, too: at rest it is the best one.
        if before is None:
            scale = _POOL_SCALE * self._focal_length
            before = self.optimize(observed, start.state, scale, observed.terms)
            before = self._facing(observed, start, near, before)
        rotations = [rotation_of(start.state)]
        pools = _pools_of(observed.observations, near)
        pools += _pools(observed, np.arange(observed.observations.count))
        draws = Draws(rotations, pools, self._config.confidence, most, observed.random)
        return search(observed.observations, self._motions, observed.terms, draws, before)

    def _facing(
        self, observed: Observed, start: Candidate, near: IntArray, found: Candidate
    ) -> Candidate:
        """A motion before a plane that faces the camera, where the start's own led nowhere.

        Turning and moving stretch and shear the image of a plane, so that the global-shutter pose
        leans by tens of degrees; from there the way leads to other leans, and samples of six noisy
        points tell leaning from moving no better.
        """
        if np.count_nonzero(self._inliers(observed, found)[near]) >= _SAME_GROUP * len(near):
            return found
        observations, threshold = observed.observations, self._config.inlier_threshold
        among = np.ones(len(near), dtype=np.bool_)
        towards = facing(observations.points[near], among, start.state)
        if towards is None:
            return found
        state, cost = descend(
            observations.packed, towards,
            _POOL_SCALE * self._focal_length, threshold, observed.terms,
            EXPECTED_NOISE * threshold,
        )  # fmt: skip
        return Candidate(state, cost) if cost < found.cost else found

    def _hypotheses(
        self, solver: Solver, block: int, score_scale: float, final_scale: float
    ) -> Hypotheses:
        return Hypotheses(
            solve=solver.solve,
            sample_size=solver.sample_size,
            solutions=solver.solutions,
            block=block,
            score_scale=score_scale,
            final_scale=final_scale,
            noise=EXPECTED_NOISE * self._config.inlier_threshold,
            iterations=self._config.solver_iterations,
        )

    def optimize(
        self, observed: Observed, state: Array, first_scale: float, terms: PriorTerms
    ) -> Candidate:
        """Local optimisation of one state down to the inlier threshold."""
        optimized, cost = optimize(
            state[None],
            np.zeros(1),
            observed.observations.packed,
            first_scale,
            self._config.inlier_threshold,
            terms,
            EXPECTED_NOISE * self._config.inlier_threshold,
        )
        return Candidate(optimized, cost)

    def global_shutter_inliers(self, observed: Observed, start: Candidate) -> int:
        """How many points a global-shutter pose explains at the inlier threshold."""
        threshold = self._config.inlier_threshold
        pose = self.optimize(
            observed, at_rest(start.state), 2.0 * _SCORE_SCALE * threshold, held_terms()
        )
        return int(np.count_nonzero(observed.observations.within(pose.state, threshold)))


def _pools(observed: Observed, among: IntArray) -> list[Pool]:
    everything = _pools_of(observed.observations, among)
    # Half of the samples ignore the scores, so that wrong ones cost a factor of two at most.
    if observed.ranking is None:
        return everything
    ranked = observed.ranking[np.isin(observed.ranking, among)]
    return _pools_of(observed.observations, ranked, ranked=True) + everything


def _pools_of(observations: Observations, among: IntArray, ranked: bool = False) -> list[Pool]:
    """A pool for each camera, which gives a share of the samples that is as large as its own."""
    pools, of_camera = [], observations.camera
    for camera in range(len(observations.mounts.axes)):
        chosen = among[of_camera[among] == camera]
        if len(chosen):
            rows = float(np.ptp(observations.tau[of_camera == camera]))
            pools.append(Pool(chosen, rows, ranked, len(chosen) / len(among)))
    return pools
