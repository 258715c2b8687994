"""The robust loop: draw samples in blocks, solve, score, optimise the best, stop when sure.

It knows a solver only as a function that turns samples into models.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.state import STATE_SIZE
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.prior_terms import PriorTerms
from rs_localizer.estimation.sampling import Pool, Random, draw
from rs_localizer.estimation.scoring import best_models, optimize

MODEL_SIZE = 18

# Of every block this many hypotheses are optimised: a six-point model of inliers alone is often
# not the first in a block, because noise makes it miss most of the other inliers.
_KEEP = 2


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """How samples become models, and how models are judged.

    ``solve(points, rays, tau, samples, rotations, models)`` fills models (k,18,h), see
    :mod:`rs_localizer.solvers.batch`.
    """

    solve: Callable[[Array, Array, Array, IntArray, Array, Array], None]
    sample_size: int
    solutions: int
    block: int  # samples per block
    score_scale: float  # px, truncation of the error of minimal models
    final_scale: float  # px, truncation after local optimisation: the inlier threshold
    prior: PriorTerms
    noise: float  # px, expected standard deviation


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
    observations: Observations, hypotheses: Hypotheses, draws: Draws, start: Candidate
) -> Candidate:
    """The best optimised hypothesis of up to ``draws.most`` minimal samples.

    Blocks take the initial rotations in turn and draw equally from all pools. The search stops
    when the chance that no sample so far held inliers alone, at the inlier ratios of the best
    *optimised* motion, is below ``1 - draws.confidence``: minimal models see too few of the inliers
    to count them (a six-point model sees a tenth). Only models that beat all minimal ones before
    are optimised (LO-RANSAC: Chum, Matas, Kittler, DAGM 2003). The samples of ``start`` count: a
    search goes on from where another stopped.
    """
    usable = [pool for pool in draws.pools if len(pool.points) >= hypotheses.sample_size]
    best = start
    inliers = _inliers(observations, best, hypotheses.final_scale)
    drawn, blocks = [start.samples // max(len(usable), 1)] * len(usable), 0
    no_fit, best_gain = len(observations) * hypotheses.score_scale**2, 0.0
    while usable and (left := draws.most - sum(drawn)) > 0:
        samples = np.empty((min(hypotheses.block, left), hypotheses.sample_size), dtype=np.int64)
        _draw(observations, usable, drawn, draws.random, samples)
        models = np.empty((hypotheses.solutions, MODEL_SIZE, len(samples)))
        blocks += 1
        rotation = draws.rotations[blocks % len(draws.rotations)]
        hypotheses.solve(
            observations.points, observations.rays, observations.tau, samples,
            rotation[None], models,
        )  # fmt: skip
        states, costs = best_models(
            models, observations.packed, observations.row_time_gradient,
            hypotheses.score_scale, _KEEP, no_fit - best_gain,
        )  # fmt: skip
        best_gain = max(best_gain, no_fit - float(costs[0]))
        state, cost = optimize(
            states, costs, observations.packed, observations.row_time_gradient,
            2.0 * hypotheses.score_scale, hypotheses.final_scale, hypotheses.prior,
            hypotheses.noise,
        )  # fmt: skip
        if cost < best.cost:
            best = Candidate(state, cost)
            inliers = _inliers(observations, best, hypotheses.final_scale)
        if _missed(inliers, usable, drawn, hypotheses.sample_size) < 1.0 - draws.confidence:
            break
    return Candidate(best.state, best.cost, sum(drawn))


def _draw(
    observations: Observations,
    pools: Sequence[Pool],
    drawn: list[int],
    random: Random,
    samples: IntArray,
) -> None:
    """Fill the samples from all pools in equal parts, and count what each has given."""
    count, size = samples.shape
    first = 0
    for index, pool in enumerate(pools):
        part = samples[first : (index + 1) * count // len(pools)]
        prefixes = pool.prefix_sizes(drawn[index], len(part), size)
        draw(pool.points, prefixes, observations.tau, observations.row_range, random, part)
        drawn[index] += len(part)
        first += len(part)


def _inliers(observations: Observations, candidate: Candidate, scale: float) -> BoolArray:
    if not candidate.found:
        return np.zeros(len(observations), dtype=np.bool_)
    inliers: BoolArray = observations.squared_errors(candidate.state) < scale * scale
    return inliers


def _missed(inliers: BoolArray, pools: Sequence[Pool], drawn: Sequence[int], size: int) -> float:
    """Chance that none of the samples drawn from the pools held inliers alone."""
    missed = 1.0
    for pool, count in zip(pools, drawn, strict=True):
        share = np.count_nonzero(inliers[pool.points]) / len(pool.points)
        missed *= (1.0 - share**size) ** count
    return missed
