# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The robust loop: draw samples in blocks, solve, score, optimise the best, stop when sure.

It knows a solver only as a function that turns samples into models.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray, Random
from rs_localizer.core.blocks import write
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.simd.tracing import LANES
from rs_localizer.core.state import STATE_SIZE
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.prior import PriorTerms, held_terms
from rs_localizer.estimation.refine import anneal, refine
from rs_localizer.estimation.residuals import POINT_SIZE, truncated_cost
from rs_localizer.solvers.batch import MODEL_SIZE, into_rig


def generator(seed: int) -> Random:
    """A random generator that kernels can draw from."""
    return np.array([seed], dtype=np.uint64)


# A sample whose rows lie closer together than this part of all rows hardly sees the motion.
_LEAST_ROW_SPREAD = 0.25
_MOST_REDRAWS = 8
# After so many samples a ranked pool is drawn from as a whole (T_N of the PROSAC paper).
_RANKED_HORIZON = 200_000


@dataclass(frozen=True, slots=True, eq=False)
class Pool:
    """Points of one camera to draw from.

    ``ranked``: they are sorted from the best to the worst and the first samples come from the
    first of them (PROSAC: Chum, Matas, "Matching with PROSAC", CVPR 2005).
    """

    points: IntArray
    row_range: float  # of the row times of its camera's points
    ranked: bool = False
    share: float = 1.0  # of the samples, beside those of the other pools

    def prefix_sizes(self, first: int, count: int, size: int) -> IntArray:
        """From how many points of the pool samples ``first ... first + count - 1`` are drawn."""
        total = len(self.points)
        if not self.ranked or total <= size:
            return np.full(count, total, dtype=np.int64)
        n = np.arange(size, total + 1)
        # Expected number of the horizon's samples that lie in the first n points (T_n there).
        factors = (n[:, None] - np.arange(size)) / (total - np.arange(size))
        expected = _RANKED_HORIZON * np.prod(factors, axis=1)
        drawn = np.arange(first + 1, first + count + 1)
        return np.minimum(size + np.searchsorted(expected, drawn), total).astype(np.int64)


@inlined
def _next(random: Any) -> Any:
    """SplitMix64 (Steele, Lea, Flood, OOPSLA 2014): the next 64 bits; ``random`` is (1,) uint64."""
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


# Of local optimisation, at the last scale.
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
    """States (keep,24) and costs (keep,) of the models (k,18,h) with the least truncated error.

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


@kernel
def optimize(
    states: Array,
    costs: Array,
    data: Array,
    first_scale: float,
    last_scale: float,
    prior: PriorTerms,
    noise: float,
) -> tuple[Array, float]:
    """Local optimisation of the states with finite cost; the best state and its truncated cost.

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


@kernel
def descend(
    data: Array,
    start: Array,
    first_scale: float,
    last_scale: float,
    prior: PriorTerms,
    noise: float,
) -> tuple[Array, float]:
    """As :func:`optimize`, of one state, with steps that are tried before they are taken.

    It takes ten times as long and comes through where pose and motion are hard to tell apart.
    """
    state, scale, iterations = start, first_scale, _FIRST_STEPS
    while scale > last_scale:
        state, _, _, _ = refine(data, state, scale, 1.0, prior, noise, 1, iterations, _TOLERANCE)
        scale, iterations = _RATIO * scale, _STEPS
    state, _, _, _ = refine(data, state, last_scale, 1.0, prior, noise, 1, _FIRST_STEPS, _TOLERANCE)
    return state, truncated_cost(data, state, last_scale, np.inf)


def warm_up() -> None:
    """Compile what a plane comes to that faces the camera."""
    nothing = np.zeros((0, POINT_SIZE * LANES))
    descend(nothing, np.zeros(STATE_SIZE), 1.0, 1.0, held_terms(), 1.0)


# Of every block this many hypotheses are optimised: a six-point model of inliers alone is often
# not the first in a block, because noise makes it miss most of the other inliers.
_KEEP = 2


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """How samples become models, and how models are judged.

    ``solve(points, rays, tau, samples, rotations, iterations, models)`` fills models (k,18,h), see
    :mod:`rs_localizer.solvers.batch`.
    """

    solve: Callable[[Array, Array, Array, IntArray, Array, int, Array], None]
    sample_size: int
    solutions: int
    block: int  # samples per block
    score_scale: float  # px, truncation of the error of minimal models
    final_scale: float  # px, truncation after local optimisation: the inlier threshold
    noise: float  # px, expected standard deviation
    iterations: int = 0  # of an iterative solver


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """The best motion so far."""

    state: Array  # (24,) of model B
    cost: float  # truncated, squared pixels
    samples: int = 0  # drawn until then

    @property
    def found(self) -> bool:
        return bool(np.isfinite(self.cost))


NOTHING = Candidate(np.zeros(STATE_SIZE), math.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Draws:
    """Where samples come from, and how many there may be."""

    rotations: Sequence[Array]  # (3,3) to start from, in turn
    pools: Sequence[Pool]
    confidence: float
    most: int
    random: Random


def search(
    observations: Observations, hypotheses: Hypotheses, prior: PriorTerms, draws: Draws,
    start: Candidate,
) -> Candidate:  # fmt: skip
    """The best optimised hypothesis of up to ``draws.most`` minimal samples.

    Blocks take the initial rotations in turn and draw equally from all pools. The search stops
    when the chance that no sample so far held inliers alone, at the inlier ratios of the best
    *optimised* motion, is below ``1 - draws.confidence``: minimal models see too few of the inliers
    to count them (a six-point model sees a tenth). Only models that beat all minimal ones before
    are optimised (LO-RANSAC: Chum, Matas, Kittler, DAGM 2003). The samples of ``start`` count: a
    search goes on from where another stopped.
    """
    size, count = hypotheses.sample_size, observations.count
    usable = [pool for pool in draws.pools if len(pool.points) >= size]
    best, inliers = start, np.zeros(count, dtype=np.bool_)
    if start.found:
        inliers = observations.within(start.state, hypotheses.final_scale)
    drawn, blocks = [start.samples // max(len(usable), 1)] * len(usable), 0
    ends, mounts = list(accumulate(pool.share for pool in usable)), observations.mounts
    rotations = [mounts.axes @ rotation for rotation in draws.rotations]
    no_fit, best_gain = count * hypotheses.score_scale**2, 0.0
    while usable and (left := draws.most - sum(drawn)) > 0:
        samples = np.empty((min(hypotheses.block, left), size), dtype=np.int64)
        _draw(observations, usable, ends, drawn, draws.random, samples)
        models = np.empty((hypotheses.solutions, MODEL_SIZE, len(samples)))
        blocks += 1
        camera = observations.camera[samples[:, 0]]
        hypotheses.solve(
            observations.points, observations.rays, observations.tau, samples,
            rotations[blocks % len(rotations)][camera], hypotheses.iterations, models,
        )  # fmt: skip
        into_rig(models, camera, mounts)
        states, costs = best_models(
            models, observations.packed,
            hypotheses.score_scale, _KEEP, no_fit - best_gain,
        )  # fmt: skip
        best_gain = max(best_gain, no_fit - float(costs[0]))
        state, cost = optimize(
            states, costs, observations.packed,
            2.0 * hypotheses.score_scale, hypotheses.final_scale, prior, hypotheses.noise,
        )  # fmt: skip
        if cost < best.cost:
            best = Candidate(state, cost)
            inliers = observations.within(state, hypotheses.final_scale)
        if _missed(inliers, usable, drawn, size) < 1.0 - draws.confidence:
            break
    return Candidate(best.state, best.cost, sum(drawn))


def _draw(
    observations: Observations, pools: Sequence[Pool], ends: Sequence[float], drawn: list[int],
    random: Random, samples: IntArray,
) -> None:  # fmt: skip
    """Fill the samples from all pools by their shares, and count what each has given.

    ``ends``: the sums of the shares so far.
    """
    count, size = samples.shape
    first = 0
    for index, pool in enumerate(pools):
        part = samples[first : count if pool is pools[-1] else int(ends[index] * count / ends[-1])]
        if pool.ranked:
            prefixes = pool.prefix_sizes(drawn[index], len(part), size)
        else:
            prefixes = np.full(len(part), len(pool.points), dtype=np.int64)
        draw(pool.points, prefixes, observations.tau, pool.row_range, random, part)
        drawn[index] += len(part)
        first += len(part)


def _missed(inliers: BoolArray, pools: Sequence[Pool], drawn: Sequence[int], size: int) -> float:
    """Chance that none of the samples drawn from the pools held inliers alone."""
    missed = 1.0
    for pool, count in zip(pools, drawn, strict=True):
        share = np.count_nonzero(inliers[pool.points]) / len(pool.points)
        missed *= (1.0 - share**size) ** count
    return missed
