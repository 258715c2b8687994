# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What minimal problems cost.

Of frames: ``python -m benchmarks.frames times``.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.experiments.results import Context, Result, Table, limited, rounded
from benchmarks.experiments.trials import Setting, Trials, draw_trials
from rs_localizer.solvers.batch import MODEL_SIZE
from rs_localizer.solvers.table import SOLVERS, find_solver

_BATCH = 4096
_REFERENCE = "numpy.linalg.solve of 12x12"
_SETTING = Setting(angular=10.0, linear=0.1, noise=0.5)
_REPEATS_PER_TRIAL = 0.02
_FEWEST, _MOST = 5, 41


class Budget(NamedTuple):
    """A solver to be timed, and what it may cost in units of one 12x12 solve."""

    solver: str
    iterations: int = 1
    at_most: float = np.inf
    paper_us: float = np.nan  # per iteration, Table 1 of the paper

    @property
    def name(self) -> str:
        return f"{self.solver}_{self.iterations}"


_BUDGETS = (
    Budget("p3p", 1, 0.30, 3.0), Budget("r6p_vcwt", 1, 0.20, 10.0),
    Budget("r6p_vcwt", 5, 0.60, 10.0), Budget("r6p_vct_w", 1, 0.45, 24.0),
    Budget("r6p_vct_wt", 1, 0.45, 30.0), Budget("r6p_vc_wt", 1, 0.45, 27.0),
    Budget("r9p", 1, 0.60, 20.0), Budget("r6p", 1, 140.0, 1700.0),
)  # fmt: skip


def run(context: Context) -> Result:
    """One core, and turns that all solvers take in order: the machine has other things to do.

    Times are medians, ratios medians over the turns, of minimal problems in batches of 4096. The
    paper's times are those of its Table 1 (2.5 GHz i7).
    """
    repeats = int(np.clip(_REPEATS_PER_TRIAL * context.trials, _FEWEST, _MOST))
    others = [name for name in SOLVERS if name not in {budget.solver for budget in _BUDGETS}]
    budgets = [*_BUDGETS, *map(Budget, others)]
    trials = draw_trials(_BATCH, context.seed, _SETTING)
    rng = np.random.default_rng(context.seed)
    matrices, right = rng.normal(size=(_BATCH, 12, 12)), rng.normal(size=(_BATCH, 12, 1))
    subjects: dict[str, Callable[[], object]] = {}
    subjects[_REFERENCE] = lambda: np.linalg.solve(matrices, right)
    subjects |= {budget.name: _solver(budget, trials) for budget in budgets}
    times: dict[str, list[float]] = {name: [] for name in subjects}
    for subject in subjects.values():
        subject()  # compiles, fills caches
    for _ in context.track(range(repeats), repeats):
        # In turns, so that a slow moment of the machine hits all of them alike.
        for name, subject in subjects.items():
            start = time.perf_counter()
            subject()
            times[name].append(1e6 * (time.perf_counter() - start) / _BATCH)
    us = {name: float(np.median(each)) for name, each in times.items()}
    shares = {
        name: float(np.median(np.divide(each, times[_REFERENCE]))) for name, each in times.items()
    }
    shown = Table(
        ("us of a minimal problem", "iterations", "here", "of a 12x12 solve", "paper, 2.5 GHz i7"),
        [
            (one.solver, one.iterations, rounded(us[one.name]), rounded(shares[one.name]),
             "" if np.isnan(one.paper_us) else rounded(one.paper_us * one.iterations))
            for one in budgets
        ],
    )  # fmt: skip
    return Result(
        [
            *(
                limited(
                    f"timings.{one.name}",
                    f"{one.solver}, {one.iterations} iteration(s), costs a fraction of a solve",
                    f"time over that of `{_REFERENCE}`", shares[one.name], most=one.at_most,
                    why="the machine had other work, or is of another kind: compare the columns "
                    "with each other",
                )
                for one in _BUDGETS
            ),
            limited(
                "timings.faster_than_paper",
                "every solver is faster than in the paper's Table 1", "gain per iteration",
                [one.paper_us * one.iterations / us[one.name] for one in _BUDGETS], least=1.0,
            ),
        ],
        [shown.text()],
    )  # fmt: skip


def _solver(budget: Budget, trials: Trials) -> Callable[[], object]:
    solver = find_solver(budget.solver)
    n = solver.sample_size
    points, rays, tau = (
        np.ascontiguousarray(x[:, :n]) for x in (trials.points, trials.rays, trials.tau)
    )
    samples = np.arange(_BATCH * n, dtype=np.int64).reshape(_BATCH, n)
    models = np.empty((solver.solutions, MODEL_SIZE, _BATCH))
    return lambda: solver.solve(
        points.reshape(-1, 3), rays.reshape(-1, 2), tau.ravel(), samples, trials.truth.rotation,
        budget.iterations, models,
    )  # fmt: skip
