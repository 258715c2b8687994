# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The search for the motion of an image: a global-shutter start, then the solver's hypotheses.

The robust loop draws samples in blocks, solves, scores, optimizes the best, and stops when it is
sure. It knows a solver only as a function that turns samples into models.
"""

from __future__ import annotations

import math
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import numpy as np

from rs_localizer.config import LocalizerConfig, RefinementKind
from rs_localizer.core.arrays import (
    Array,
    Array1,
    Array2,
    Array3,
    BoolArray,
    IntArray,
    IntArray1,
    IntArray2,
    Out,
    Random,
)
from rs_localizer.core.blocks import write
from rs_localizer.core.rig import Mounts
from rs_localizer.core.state import STATE_SIZE, rotation_of
from rs_localizer.core.types import altered
from rs_localizer.estimation.points import Observations, Observed, leaning_less, plane_of
from rs_localizer.estimation.prior import PriorTerms, held_terms
from rs_localizer.estimation.projection import truncated_cost
from rs_localizer.estimation.robust import EXPECTED_NOISE, anneal, refine
from rs_localizer.native import entry, inlined, kernel
from rs_localizer.solvers.batch import MODEL_SIZE, into_rig
from rs_localizer.solvers.table import Solver


def generator(seed: int) -> Random:
    """Return a random generator that kernels can draw from."""
    return np.array([seed], dtype=np.uint64)


# A sample whose rows lie closer together than this part of all rows hardly sees the motion.
_LEAST_ROW_SPREAD = 0.25
_MOST_REDRAWS = 8
# Sides of one camera differ in their centres (m) by rounding.
_ONE_PLACE = 1e-9
# Number of samples after which a ranked pool is drawn from as a whole (T_N of the PROSAC paper).
_RANKED_HORIZON = 200_000


class Pool(NamedTuple):
    """Points of one camera to draw from.

    In a ranked pool they are sorted from the best to the worst, and the first samples come from the
    first of them (PROSAC: Chum, Matas, "Matching with PROSAC", CVPR 2005).
    """

    points: IntArray1  # (n,)
    share: float  # of the samples
    # (k,) samples that lie in the first points, from a sample's size on; (0,): all are alike
    growth: Array1

    @classmethod
    def of(cls, points: IntArray, share: float, ranked: int) -> Pool:
        """Return a pool, ``ranked`` for samples of this size; 0: not at all."""
        total, growth = len(points), np.zeros(0)
        if ranked:
            k = np.arange(ranked)
            first = np.arange(ranked, total)[:, None]
            growth = _RANKED_HORIZON * np.prod((first - k) / (total - k), axis=1)
        return cls(points, share, growth)


def pools_of(
    sides: IntArray, size: int, among: BoolArray, ranking: IntArray, also_all: bool
) -> list[Pool]:
    """Return a pool for each side with enough points for a sample.

    Half of the samples ignore the scores, so that wrong ones cost a factor of two at most.

    Args:
        sides: (n,) of a camera, or cameras, by which each point is seen.
        size: of a sample.
        among: (n,) which points to take.
        ranking: points from the best to the worst; empty: they are alike.
        also_all: take all points, too, beside these; then only all are ranked.
    """
    chosen, pools = np.flatnonzero(among), []
    groups = [(np.arange(len(among)) if also_all else chosen, 0)]
    if len(ranking):
        groups.insert(0, (ranking if also_all else ranking[among[ranking]], size))
    if also_all:
        groups.insert(0, (chosen, 0))
    count = int(sides.max(initial=0)) + 1
    for place in range(count):
        for points, ranked in groups:
            own = points[sides[points] == place] if count > 1 else points
            if len(own) >= size:
                pools.append(Pool.of(own, len(own) / len(points), ranked))
    return pools


def views_of(observations: Observations, solver: Solver) -> IntArray:
    """Return numbers (n,) of the sides that see points, or of the cameras if rows do not matter.

    A camera has the number of its first side. All sides of a camera lie at one place.
    """
    mounts, sides = observations.mounts, observations.camera
    if solver.rolling_shutter or len(mounts.axes) == 1:
        return sides
    apart = np.abs(mounts.centres[:, None] - mounts.centres).max(axis=2)
    first = (apart < _ONE_PLACE).argmax(axis=1)
    return first[sides] if len(set(first.tolist())) < len(first) else sides


@inlined
def _next(random: Any) -> Any:
    """Return the next 64 bits of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014); ``random`` (1,)."""
    random[0] += np.uint64(0x9E3779B97F4A7C15)
    z = random[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@entry
def draw(
    pool: Pool, drawn: int, tau: Array1, camera: IntArray1, random: Random, samples: Out[IntArray2]
) -> None:  # fmt: skip
    """Fill ``samples`` (h,n) with distinct points of the pool, row by row.

    Args:
        drawn: samples before these.
        tau, camera: (n,) row times of all points, and which side sees each.
    """
    count, size = samples.shape
    points = pool.points
    latest, earliest = -np.inf, np.inf  # of the camera's points
    for i in range(len(tau)):
        if camera[i] == camera[points[0]]:
            latest, earliest = max(latest, tau[i]), min(earliest, tau[i])
    least = _LEAST_ROW_SPREAD * (latest - earliest)
    for h in range(count):
        among = int(np.searchsorted(pool.growth, drawn + h + 1.0))
        among += len(points) - len(pool.growth)
        for _ in range(_MOST_REDRAWS):
            first, last = np.inf, -np.inf
            for i in range(size):
                repeated = True
                while repeated:
                    # The upper 32 bits times the size: unbiased to 2^-32 and without a division.
                    position = ((_next(random) >> np.uint64(32)) * np.uint64(among)) >> (
                        np.uint64(32)
                    )
                    point = points[position]
                    repeated = False
                    for k in range(i):
                        repeated = repeated or samples[h, k] == point
                samples[h, i] = point
                first = min(first, tau[point])
                last = max(last, tau[point])
            if last - first >= least:
                break


# The best two hypotheses of every block are optimized: a six-point model of inliers alone is often
# not the first in a block, because noise makes it miss most of the other inliers.
_KEEP = 2
# Iterations of local optimization at the last scale.
_ITERATIONS = 3
# Gain, in noise variances, below which another step is not worth its time.
_TOLERANCE = 1.0


@kernel
def state_of_model(model: Array) -> Array:
    """State (model B) of a solver's model A (18,): ``omega = -w``, ``v = w x C - t``."""
    state = np.zeros(STATE_SIZE)
    for k in range(12):
        state[k] = model[k]
    c, w, t = model[9:12], model[12:15], model[15:18]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        state[12 + i] = -w[i]
        state[15 + i] = w[j] * c[k] - w[k] * c[j] - t[i]
    return state


@entry
def best_models(
    models: Out[Array3], camera: IntArray1, mounts: Mounts, data: Array2, scale: float, bar: float
) -> tuple[Array, Array]:
    """Return states (k,24) and costs (k,) of the models with the least truncated error.

    Models (k,18,h) are those of cameras (h,), and become those of their rig.
    A model is left as soon as its cost exceeds that of the worst kept one, or ``bar``. Places that
    no model takes have infinite cost.
    """
    into_rig(models, camera, mounts)
    states, costs = np.zeros((_KEEP, STATE_SIZE)), np.full(_KEEP, np.inf)
    solutions, _, count = models.shape
    for h in range(count):
        for s in range(solutions):
            if np.isnan(models[s, 0, h]):
                continue
            state = state_of_model(models[s, :, h])
            limit = min(costs[_KEEP - 1], bar)
            cost = truncated_cost(data, state, scale, limit)
            if cost < limit:
                place = _KEEP - 1
                while place > 0 and cost < costs[place - 1]:
                    costs[place] = costs[place - 1]
                    write(states[place], states[place - 1])
                    place -= 1
                costs[place] = cost
                write(states[place], state)
    return states, costs


@entry
def optimize(
    states: Array2, costs: Array1, data: Array2, first_scale: float, last_scale: float,
    prior: PriorTerms, noise: float,
) -> tuple[Array, float]:  # fmt: skip
    """Optimize states with finite cost locally; return the best state and its truncated cost.

    Each is refined on all points under Tukey's loss while its scale falls from the first to the
    last; the truncated cost is that of the last scale.
    """
    best = np.zeros(STATE_SIZE)
    best_cost = np.inf
    for i in range(len(states)):
        if not np.isfinite(costs[i]):
            continue
        state = anneal(data, states[i], first_scale, last_scale, prior, noise)
        state, _, _, _ = refine(
            data, state, (last_scale, 1.0), prior, noise, 1, _ITERATIONS, _TOLERANCE
        )
        cost = truncated_cost(data, state, last_scale, best_cost)
        if cost < best_cost:
            best, best_cost = state, cost
    return best, best_cost


class Candidate(NamedTuple):
    """The best motion so far."""

    state: Array  # (24,) of model B
    cost: float  # truncated, squared pixels
    samples: int = 0  # drawn until then

    @property
    def found(self) -> bool:
        return self.cost < math.inf


NOTHING = Candidate(np.zeros(STATE_SIZE), math.inf)


def _across(seen: Observations, samples: IntArray) -> tuple[Observations, IntArray]:
    """Return the points of samples (h,3), each seen by a side of its own, and where they are (h,3).

    The plane through the tips of three bearings is the image of a side that looks along its normal:
    they lie before it, whichever sides of one camera saw them.
    """
    chosen, count = samples.ravel(), len(samples)
    side = seen.camera[chosen]
    bearings = np.column_stack([seen.rays[chosen], np.ones(len(chosen))])
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    bearings = np.einsum("nij,ni->nj", seen.mounts.axes[side], bearings).reshape(count, 3, 3)
    along = bearings[:, 1] - bearings[:, 0]
    normal = np.cross(along, bearings[:, 2] - bearings[:, 0])
    normal *= np.sign(np.sum(normal * bearings[:, 0], axis=1, keepdims=True))
    axes = np.stack([along, np.cross(normal, along), normal], axis=1)
    with np.errstate(all="ignore"):  # equal bearings have no plane, and the solver finds no pose
        axes /= np.linalg.norm(axes, axis=2, keepdims=True)
        rays = (bearings @ axes.transpose(0, 2, 1)).reshape(-1, 3)
        rays = rays[:, :2] / rays[:, 2:]
    mounts = Mounts(axes, seen.mounts.centres[side[::3]], np.zeros((count, 2)))
    return altered(
        seen, points=seen.points[chosen], rays=rays, tau=seen.tau[chosen],
        camera=np.arange(count).repeat(3), mounts=mounts,
    ), np.arange(3 * count).reshape(count, 3)  # fmt: skip


class Hypotheses(NamedTuple):
    """How samples become models, and how models are judged."""

    solver: Solver
    block: int  # samples per block
    most: int  # samples
    score_scale: float  # px, truncation of the error of minimal models
    final_scale: float  # px, truncation after local optimization: the inlier threshold
    noise: float  # px, expected standard deviation
    iterations: int  # of an iterative solver
    confidence: float  # that a sample held inliers alone, when the search stops
    optimized: bool = True  # False: minimal models are judged as they are


def search(
    observed: Observed, hypotheses: Hypotheses, prior: PriorTerms, pools: list[Pool],
    rotation: Array, start: Candidate,
) -> Candidate:  # fmt: skip
    """Return the best optimized hypothesis of minimal samples.

    Blocks draw from all pools by their shares. The search stops when some sample probably held
    inliers alone, at the inlier ratios of the best *optimized* motion: minimal models see too few
    of the inliers to count them (a six-point model sees a tenth). Only models that beat all minimal
    ones before are optimized (LO-RANSAC: Chum, Matas, Kittler, DAGM 2003). Where none is, the best
    minimal model counts, and the search ends late.

    Args:
        rotation: (3,3) that solvers start from.
    """
    observations, solver = observed.observations, hypotheses.solver
    data, tau, sides = observations.packed, observations.tau, views_of(observations, solver)
    is_wide = sides is not observations.camera
    score, final, noise = hypotheses.score_scale, hypotheses.final_scale, hypotheses.noise
    best, inlier_ratios, drawn = start, None, [0] * len(pools)
    shares = [*accumulate(pool.share for pool in pools)]
    bar = len(observations) * score**2
    left = hypotheses.most if pools else 0
    while left > 0:
        samples = np.empty((min(hypotheses.block, left), solver.sample_size), np.int64)
        ends = [int(share / shares[-1] * len(samples)) for share in shares]
        for k, (first, last) in enumerate(pairwise([0, *ends])):
            draw(pools[k], drawn[k], tau, sides, observed.random, samples[first:last])
            drawn[k] += last - first
        models = np.empty((solver.solutions, MODEL_SIZE, len(samples)))
        seen, places = _across(observations, samples) if is_wide else (observations, samples)
        camera = seen.camera[places[:, 0]]
        solver.solve(
            seen.points, seen.rays, seen.tau, places, (seen.mounts.axes @ rotation)[camera],
            hypotheses.iterations, models,
        )  # fmt: skip
        states, costs = best_models(models, camera, seen.mounts, data, score, bar)
        found = Candidate(states[0], costs[0])
        if hypotheses.optimized:
            found = Candidate(*optimize(states, costs, data, 2.0 * score, final, prior, noise))
        if found.cost < best.cost:
            best, inlier_ratios = found, None
        left = hypotheses.most - sum(drawn)
        if inlier_ratios is None and best.found and left > 0:
            near = observations.within(best.state, final)
            inlier_ratios = [np.count_nonzero(near[it.points]) / len(it.points) for it in pools]
        bar = min(bar, float(costs[0]))
        if inlier_ratios is not None:  # the chance that no sample held inliers alone
            each = zip(inlier_ratios, drawn, strict=True)
            missed = math.prod((1.0 - ratio**solver.sample_size) ** count for ratio, count in each)
            if missed < 1.0 - hypotheses.confidence:
                break
    return best._replace(samples=sum(drawn))


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
# A start leads nowhere if its own motion fits less than this part of the points near it; and if it
# fits this one, samples lead to no other motion (ten frames each of all conditions that are timed),
# unless the points lie on a plane, which may lean otherwise.
_AGREEING, _SURELY = 0.5, 0.9


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
        wide = max(GLOBAL_SHUTTER_SCALE * focal_length, threshold)
        score = (SCORE_SCALE if self._optimizes else 1.0) * threshold
        scales = (wide, wide) if solver.rolling_shutter else (score, threshold)
        self._starts = Hypotheses(
            start, _GLOBAL_SHUTTER_BLOCK, config.max_iterations, *scales, self._noise,
            config.solver_iterations, config.confidence, self._optimizes,
        )  # fmt: skip
        self._motions = self._starts._replace(
            solver=solver, block=_BLOCK, score_scale=score, final_scale=threshold
        )

    def find(self, observed: Observed) -> Candidate:
        """Find the motion from a global-shutter start, or nothing."""
        most = self._config.max_iterations
        if not self._solver.rolling_shutter:
            return self._global_shutter(observed, most)
        start = self._global_shutter(observed, min(_FEW_SAMPLES, most))
        return self._motion(observed, start, most)

    def rough(self, observed: Observed) -> Candidate:
        """Find a pose that fits all rows of enough points roughly, or nothing.

        One block finds three inliers if two fifths of the points are inliers.
        """
        return self._global_shutter(observed, _GLOBAL_SHUTTER_BLOCK)

    def from_rough(self, observed: Observed, start: Candidate) -> Candidate:
        """Find the motion of most points near a rough pose, by few samples."""
        return self._motion(observed, start, _FEW_SAMPLES)

    def _global_shutter(self, observed: Observed, most: int) -> Candidate:
        """Find a pose that fits all rows roughly, with a wide threshold."""
        observations = observed.observations
        every, size = np.ones(len(observations), np.bool_), self._start.sample_size
        pools = pools_of(views_of(observations, self._start), size, every, observed.ranking, False)
        starts = self._starts._replace(most=most)
        return search(observed, starts, held_terms(), pools, np.eye(3), NOTHING)

    def _motion(self, observed: Observed, start: Candidate, most: int) -> Candidate:
        """Find the motion that most points agree on, from the solver's hypotheses."""
        if not start.found:
            return start
        observations = observed.observations
        near, first = observations.within(start.state, self._near), NOTHING
        if self._optimizes:
            # The global-shutter pose is a hypothesis, too: at rest it is the best one.
            first = self.optimize(observed, start.state, self._near, observed.terms)
            agreeing = near & observations.within(first.state, self._config.inlier_threshold)
            share = np.count_nonzero(agreeing) / max(int(np.count_nonzero(near)), 1)
            if share >= _SURELY and not plane_of(observations.points, near)[0]:
                return first._replace(samples=start.samples)
            # Turning and moving stretch and shear the image of a plane that faces the camera, so
            # that the pose leans by tens of degrees. From there the way leads to other leans, and
            # samples of six noisy points tell leaning from moving no better.
            if share < _AGREEING:
                leans, towards = leaning_less(observations.points, near, start.state, 1.0)
                if leans:
                    other = self.optimize(observed, towards, self._near, observed.terms)
                    first = min(first, other, key=lambda each: each.cost)
        size = self._solver.sample_size
        pools = pools_of(observations.camera, size, near, observed.ranking, True)
        motions, turn = self._motions._replace(most=most), rotation_of(start.state)
        return search(observed, motions, observed.terms, pools, turn, first)

    def optimize(
        self, observed: Observed, state: Array, first_scale: float, terms: PriorTerms,
        last_scale: float | None = None,
    ) -> Candidate:  # fmt: skip
        """Optimize one state locally, down to a scale (px; None: the inlier threshold)."""
        optimized, cost = optimize(
            state[None], np.zeros(1), observed.observations.packed, first_scale,
            last_scale or self._config.inlier_threshold, terms, self._noise,
        )  # fmt: skip
        return Candidate(optimized, cost)
