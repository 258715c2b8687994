# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of many methods while one thing varies."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from scipy.stats import norm

from benchmarks.experiments.errors import METRICS, motion_errors
from benchmarks.experiments.methods import Method, available, estimate
from benchmarks.experiments.results import Context, Table
from benchmarks.experiments.trials import Setting, Trials, draw_trials
from benchmarks.experiments.uncertainty import CONFIDENCE, Interval
from rs_localizer.core.arrays import Array

_QUANTILES = (25.0, 50.0, 75.0)
_MEDIAN = 1
_RESAMPLED = 30

Initial = Callable[[Trials, float], Array]


@dataclass(frozen=True, slots=True, eq=False)
class Curves:
    """Quartiles of the errors of each method at each place of the sweep."""

    x_name: str
    x: Array  # (m,)
    quartiles: Mapping[str, Array]  # method -> (m,3,4): 25, 50, 75 %; metrics
    errors: Mapping[str, Array] = field(default_factory=dict)  # method -> (m,trials,4)

    def median(self, method: Method, metric: int) -> Array:
        """Medians (m,)."""
        values: Array = self.quartiles[method.name][:, _MEDIAN, metric]
        return values

    def medians(self, method: Method) -> Array:
        """Medians (m,4) of all metrics."""
        values: Array = self.quartiles[method.name][:, _MEDIAN]
        return values

    def has(self, *methods: Method) -> bool:
        return all(method.name in self.quartiles for method in methods)

    def at(self, method: Method, metric: int, x: float) -> float:
        """Median at one of the places."""
        return float(self.median(method, metric)[np.argmin(np.abs(self.x - x))])

    @property
    def trials(self) -> int:
        """Of each method at each place; 0: not known."""
        return min((values.shape[1] for values in self.errors.values()), default=0)

    def table(self) -> Table:
        columns = (self.x_name, "method", "metric", "p25", "median", "p75")
        rows: list[tuple[str | float, ...]] = [
            (float(x), name, metric.name, *map(float, values[i, :, k]))
            for name, values in self.quartiles.items()
            for i, x in enumerate(self.x)
            for k, metric in enumerate(METRICS)
        ]
        return Table(columns, rows)


def sweep(
    context: Context,
    x_name: str,
    x: Sequence[float],
    setting: Callable[[float], Setting],
    methods: Sequence[Method],
    initial: Initial | None = None,
) -> Curves:
    """Run all methods that there are on ``context.trials`` frames at each place.

    Args:
        setting: what the place of the sweep means.
        initial: initial rotations (h,3,3) of the frames; default: the true ones.
    """
    usable = available(methods)
    found: dict[str, list[Array]] = {method.name: [] for method in usable}
    for value in context.track(x, len(x)):
        here = setting(value)
        trials = draw_trials(context.trials, context.seed, here)
        start = None if initial is None else initial(trials, value)
        for method in usable:
            motions = estimate(method, trials, start, here.noise)
            found[method.name].append(motion_errors(motions, trials.truth))
    errors = {name: np.array(values) for name, values in found.items()}
    return Curves(x_name, np.array(x, float), _all_quartiles(errors), errors)


def sampled(statistic: Callable[..., float], *sweeps: Curves) -> Interval:
    """A figure of some curves, and where it lies for as many trials as one likes.

    All methods get the same resampled frames. The largest of many differences grows with their
    noise, which resampling raises by the root of two: of what it adds on the average, the trials
    themselves have added nothing where one place stands out, and 1/(root(2) - 1) times as much
    where all are alike. The interval allows for both. Without errors the figure counts as exact.
    """
    value = statistic(*sweeps)
    trials = min(curves.trials for curves in sweeps)
    if trials == 0:
        return Interval(value, value, value, 0)
    drawn = np.array([statistic(*each) for each in zip(*map(_resampled, sweeps), strict=True)])
    added = (float(np.mean(drawn)) - value) / (math.sqrt(2.0) - 1.0)
    half = float(norm.ppf(0.5 + 0.5 * CONFIDENCE) * np.std(drawn))
    low, high = value - max(0.0, added) - half, value - min(0.0, added) + half
    return Interval(value, low, high, trials)


@lru_cache(maxsize=8)
def _resampled(curves: Curves) -> list[Curves]:
    rng = np.random.default_rng(0)
    chosen = rng.integers(0, curves.trials, (_RESAMPLED, curves.trials))
    return [
        Curves(
            curves.x_name,
            curves.x,
            _all_quartiles({name: errors[:, rows] for name, errors in curves.errors.items()}),
        )
        for rows in chosen
    ]


def _all_quartiles(errors: Mapping[str, Array]) -> dict[str, Array]:
    return {name: np.array([quartiles(each) for each in values]) for name, values in errors.items()}


def quartiles(errors: Array) -> Array:
    """Quartiles (3,k) of errors (h,k), of which some may be infinite."""
    return np.asarray(np.percentile(errors, _QUANTILES, axis=0, method="nearest"))


def largest_difference(one: Array, other: Array, floor: Array) -> float:
    """Largest relative difference of two arrays of medians; errors below the floor are equal."""
    scale = np.maximum(np.maximum(np.abs(other), floor), 1e-300)
    return float(np.max(np.abs(one - other) / scale))


def crossing(x: Array, rising: Array, level: Array) -> float:
    """Where a rising curve first passes a level, by linear interpolation; NaN if nowhere."""
    above = np.flatnonzero(rising > level)
    if len(above) == 0:
        return float("nan")
    i = int(above[0])
    if i == 0:
        return float(x[0])
    before, after = rising[i - 1] - level[i - 1], rising[i] - level[i]
    return float(x[i - 1] + (x[i] - x[i - 1]) * before / (before - after))
