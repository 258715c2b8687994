# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The robust loop: draw samples in blocks, solve, score, optimize the best, stop when sure.

It knows a solver only as a function that turns samples into models.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rs_localizer.core.arrays import (
    Array,
    Array1,
    Array2,
    Array3,
    BoolArray1,
    IntArray,
    IntArray1,
    IntArray2,
    Out,
    Random,
)
from rs_localizer.core.blocks import write
from rs_localizer.core.rig import Mounts
from rs_localizer.core.state import STATE_SIZE
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.prior import PriorTerms
from rs_localizer.estimation.refine import anneal, refine
from rs_localizer.estimation.residuals import squared_errors, truncated_cost
from rs_localizer.native import entry, inlined, kernel
from rs_localizer.solvers.batch import MODEL_SIZE, into_rig
from rs_localizer.solvers.table import Solver


def generator(seed: int) -> Random:
    """Return a random generator that kernels can draw from."""
    return np.array([seed], dtype=np.uint64)


# A sample whose rows lie closer together than this part of all rows hardly sees the motion.
_LEAST_ROW_SPREAD = 0.25
_MOST_REDRAWS = 8
# Number of samples after which a ranked pool is drawn from as a whole (T_N of the PROSAC paper).
_RANKED_HORIZON = 200_000


class Pools(NamedTuple):
    """Points to draw from: those of each camera, as a pool that gives its share of the samples.

    In a ranked pool they are sorted from the best to the worst, and the first samples come from the
    first of them (PROSAC: Chum, Matas, "Matching with PROSAC", CVPR 2005).
    """

    points: IntArray1  # of all pools, one after the other
    ends: IntArray1  # (p,) where each of them ends
    row_ranges: Array1  # (p,) of the row times of its camera's points
    ranked: BoolArray1  # (p,)
    shares: Array1  # (p,) of the points that it was made of


@entry
def pools_of(
    camera: IntArray1, tau: Array1, cameras: int, size: int, among: BoolArray1, ranking: IntArray1,
    also_all: bool,
) -> Pools:  # fmt: skip
    """Return a pool for each camera with enough points for a sample.

    Half of the samples ignore the scores, so that wrong ones cost a factor of two at most.

    Args:
        camera, tau: (n,) of each point.
        size: of a sample.
        among: (n,) which points to take.
        ranking: points from the best to the worst; empty: they are alike.
        also_all: take all points, too, beside these; then only all are ranked.
    """
    count, first = len(tau), 0 if also_all else 1
    most = (3 - first) * cameras
    points, ends = np.empty((3 - first) * count, np.int64), np.empty(most, np.int64)
    row_ranges, ranked, shares = np.empty(most), np.empty(most, np.bool_), np.empty(most)
    found, end = 0, 0
    for group in range(first, 3):  # those near, by rank, and all
        if group == 1 and len(ranking) == 0:
            continue
        everyone = also_all and group > 0
        total = count if everyone else np.count_nonzero(among)
        for place in range(cameras):
            begin, low, high = end, np.inf, -np.inf
            for k in range(count):
                i = ranking[k] if group == 1 else k
                if camera[i] == place:
                    low, high = min(low, tau[i]), max(high, tau[i])
                    if everyone or among[i]:
                        points[end] = i
                        end += 1
            if end - begin < size:
                end = begin
                continue
            ends[found], row_ranges[found] = end, high - low
            ranked[found], shares[found] = group == 1, (end - begin) / total
            found += 1
    return Pools(
        points[:end].copy(), ends[:found].copy(), row_ranges[:found].copy(),
        ranked[:found].copy(), shares[:found].copy(),
    )  # fmt: skip


@kernel
def prefix_sizes(total: int, first: int, size: int, prefixes: IntArray) -> None:
    """Fill in from how many of a ranked pool's points samples ``first ...`` are drawn."""
    n = size if total > size else total
    for h in range(len(prefixes)):
        while n < total:
            # Expected number of the horizon's samples that lie in the first n points (T_n there).
            expected = 1.0 * _RANKED_HORIZON
            for k in range(size):
                expected *= (n - k) / (total - k)
            if expected >= first + h + 1:
                break
            n += 1
        prefixes[h] = n


@inlined
def _next(random: Any) -> Any:
    """Return the next 64 bits of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014); ``random`` (1,)."""
    random[0] += np.uint64(0x9E3779B97F4A7C15)
    z = random[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@kernel
def draw(pool: Any, prefixes: Any, tau: Array, row_range: float, random: Any, samples: Any) -> None:
    """Fill ``samples`` (h,n) with distinct points of the pool, row by row.

    Sample ``h`` comes from the first ``prefixes[h]`` points, which must be at least n.
    """
    count, size = samples.shape
    for h in range(count):
        for _ in range(_MOST_REDRAWS):
            first, last = np.inf, -np.inf
            for i in range(size):
                repeated = True
                while repeated:
                    # The upper 32 bits times the size: unbiased to 2^-32 and without a division.
                    position = ((_next(random) >> np.uint64(32)) * np.uint64(prefixes[h])) >> (
                        np.uint64(32)
                    )
                    point = pool[position]
                    repeated = False
                    for k in range(i):
                        repeated = repeated or samples[h, k] == point
                samples[h, i] = point
                first = min(first, tau[point])
                last = max(last, tau[point])
            if last - first >= _LEAST_ROW_SPREAD * row_range:
                break


@entry
def _draw_block(
    pools: Pools, drawn: Out[IntArray1], tau: Array1, random: Random, samples: Out[IntArray2]
) -> None:
    """Fill the samples from all pools by their shares, and count what each has given."""
    count, size = samples.shape
    prefixes, ends = np.empty(count, np.int64), np.cumsum(pools.shares)
    first, begin = 0, 0
    for k in range(len(pools.ends)):
        last = count if k == len(pools.ends) - 1 else int(ends[k] * count / ends[-1])
        points, here = pools.points[begin : pools.ends[k]], prefixes[first:last]
        if pools.ranked[k]:
            prefix_sizes(len(points), drawn[k], size, here)
        else:
            here[:] = len(points)
        draw(points, here, tau, pools.row_ranges[k], random, samples[first:last])
        drawn[k] += last - first
        first, begin = last, pools.ends[k]


# Iterations of local optimization at the last scale.
_ITERATIONS = 3
# Steps of a descent: at its first scale, where it has far to go, and at each of the others.
_FIRST_STEPS, _STEPS, _RATIO = 20, 3, 0.6
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


@kernel
def best_models(
    models: Array, data: Array, scale: float, keep: int, bar: float
) -> tuple[Array, Array]:
    """Return states (keep,24) and costs (keep,) of models (k,18,h) with the least truncated error.

    A model is left as soon as its cost exceeds that of the worst kept one, or ``bar``. Places that
    no model takes have infinite cost.
    """
    states = np.zeros((keep, STATE_SIZE))
    costs = np.empty(keep)
    costs[:] = np.inf
    solutions, _, count = models.shape
    for h in range(count):
        for s in range(solutions):
            if np.isnan(models[s, 0, h]):
                continue
            state = state_of_model(models[s, :, h])
            limit = min(costs[keep - 1], bar)
            cost = truncated_cost(data, state, scale, limit)
            if cost < limit:
                place = keep - 1
                while place > 0 and cost < costs[place - 1]:
                    costs[place] = costs[place - 1]
                    write(states[place], states[place - 1])
                    place -= 1
                costs[place] = cost
                write(states[place], state)
    return states, costs


@entry
def optimize(
    states: Array2,
    costs: Array1,
    data: Array2,
    first_scale: float,
    last_scale: float,
    prior: PriorTerms,
    noise: float,
) -> tuple[Array, float]:
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
            data, state, last_scale, 1.0, prior, noise, 1, _ITERATIONS, _TOLERANCE
        )
        cost = truncated_cost(data, state, last_scale, best_cost)
        if cost < best_cost:
            best, best_cost = state, cost
    return best, best_cost


@entry
def descend(
    data: Array2,
    start: Array1,
    first_scale: float,
    last_scale: float,
    prior: PriorTerms,
    noise: float,
) -> tuple[Array, float]:
    """Optimize one state as :func:`optimize`, with steps tried before they are taken.

    It takes ten times as long and comes through where pose and motion are hard to tell apart.
    """
    state, scale, iterations = start, first_scale, _FIRST_STEPS
    while scale > last_scale:
        state, _, _, _ = refine(data, state, scale, 1.0, prior, noise, 1, iterations, _TOLERANCE)
        scale, iterations = _RATIO * scale, _STEPS
    state, _, _, _ = refine(data, state, last_scale, 1.0, prior, noise, 1, _FIRST_STEPS, _TOLERANCE)
    return state, truncated_cost(data, state, last_scale, np.inf)


# The best two hypotheses of every block are optimized: a six-point model of inliers alone is often
# not the first in a block, because noise makes it miss most of the other inliers.
_KEEP = 2


class Candidate(NamedTuple):
    """The best motion so far."""

    state: Array  # (24,) of model B
    cost: float  # truncated, squared pixels
    samples: int = 0  # drawn until then

    @property
    def found(self) -> bool:
        return self.cost < math.inf


NOTHING = Candidate(np.zeros(STATE_SIZE), math.inf)


class Hypotheses(NamedTuple):
    """How samples become models, and how models are judged."""

    solver: Solver
    block: int  # samples per block
    score_scale: float  # px, truncation of the error of minimal models
    final_scale: float  # px, truncation after local optimization: the inlier threshold
    noise: float  # px, expected standard deviation
    iterations: int  # of an iterative solver
    optimized: bool = True  # False: minimal models are judged as they are


class Draws(NamedTuple):
    """Pools that samples come from, and how many there may be."""

    rotation: Array  # (3,3) to start from
    pools: Pools
    confidence: float
    most: int
    random: Random


def search(
    observations: Observations, hypotheses: Hypotheses, prior: PriorTerms, draws: Draws,
    start: Candidate,
) -> Candidate:  # fmt: skip
    """Return the best optimized hypothesis of up to ``draws.most`` minimal samples.

    Blocks draw equally from all pools. The search stops
    when the chance that no sample so far held inliers alone, at the inlier ratios of the best
    *optimized* motion, is below ``1 - draws.confidence``: minimal models see too few of the inliers
    to count them (a six-point model sees a tenth). Only models that beat all minimal ones before
    are optimized (LO-RANSAC: Chum, Matas, Kittler, DAGM 2003). Where none is, the best minimal
    model counts, and the search ends late.
    """
    solver, pools, mounts = hypotheses.solver, draws.pools, observations.mounts
    scales = hypotheses.score_scale, hypotheses.final_scale, hypotheses.noise
    state, cost, used = start.state, start.cost, len(pools.ends)
    drawn, shares = np.zeros(used, np.int64), np.full(used, np.nan)
    rotations = mounts.axes @ draws.rotation
    no_fit, best_gain = observations.count * hypotheses.score_scale**2, 0.0
    left = draws.most if used else 0
    while left > 0:
        samples = np.empty((min(hypotheses.block, left), solver.sample_size), np.int64)
        _draw_block(pools, drawn, observations.tau, draws.random, samples)
        models = np.empty((solver.solutions, MODEL_SIZE, len(samples)))
        camera = observations.camera[samples[:, 0]]
        solver.solve(
            observations.points, observations.rays, observations.tau, samples, rotations[camera],
            hypotheses.iterations, models,
        )  # fmt: skip
        state, cost, least, missed = _judge(
            models, camera, mounts, observations.packed, observations.count, state, cost, scales,
            no_fit - best_gain, prior, pools, drawn, shares, solver.sample_size,
            hypotheses.optimized,
        )  # fmt: skip
        best_gain = max(best_gain, no_fit - least)
        left = draws.most - int(drawn.sum())
        if missed < 1.0 - draws.confidence:
            break
    return Candidate(state, cost, int(drawn.sum()))


@entry
def _judge(
    models: Out[Array3], camera: IntArray1, mounts: Mounts, data: Array2, count: int, best: Array1,
    least: float, scales: tuple[float, float, float], bar: float, prior: PriorTerms, pools: Pools,
    drawn: IntArray1, shares: Out[Array1], size: int, optimized: bool,
) -> tuple[Array, float, float, float]:  # fmt: skip
    """Optimize the best of a block's models.

    Args:
        models: (k,18,h), of the cameras (h,).
        best, least: the best optimized state so far, and its cost.
        scales: px, truncation of minimal models and of optimized ones, expected noise.
        bar: cost that a minimal model must stay below to be optimized.
        drawn: (p,) samples from each pool until now, of ``size`` points.
        shares: (p,) of its points that are inliers of the best state, kept up to date; NaN: not
            counted yet.
        optimized: whether the best are optimized.

    Returns:
        the best state and its cost; the least cost of a minimal model; and the chance that none of
        the samples held inliers alone.
    """
    into_rig(models, camera, mounts)
    score_scale, final_scale, noise = scales
    states, costs = best_models(models, data, score_scale, _KEEP, bar)
    state, cost = states[0], costs[0]
    if optimized:
        state, cost = optimize(states, costs, data, 2.0 * score_scale, final_scale, prior, noise)
    better = cost < least
    if better:
        best, least = state, cost
    if better or (least < np.inf and np.isnan(shares[0])):
        errors, begin = squared_errors(data, count, best), 0
        for k in range(len(drawn)):
            inliers = 0
            for i in pools.points[begin : pools.ends[k]]:
                inliers += errors[i] < final_scale * final_scale
            shares[k] = inliers / (pools.ends[k] - begin)
            begin = pools.ends[k]
    missed = 1.0
    for k in range(len(drawn)):
        if shares[k] > 0.0:
            missed *= (1.0 - shares[k] ** size) ** drawn[k]
    return best, least, costs[0], missed
