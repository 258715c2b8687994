# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What a limited number of trials can say: intervals around shares, medians and ratios.

Intervals hold the true figure with a stated confidence, and verdicts are read off them
(:class:`benchmarks.experiments.results.Statement`). Trials that share a recording are not
independent: ``groups`` names the recording of each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, norm

from rs_localizer.core.arrays import Array, BoolArray

CONFIDENCE = 0.95
_RESAMPLED = 200
# Fewer groups say nothing of how much such groups differ.
_LEAST_GROUPS = 5

IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Interval:
    """A figure, and where the true one lies."""

    value: float
    low: float
    high: float
    trials: int

    def within(self, low: float, high: float) -> bool:
        """Certainly so."""
        return low <= self.low and self.high <= high

    def outside(self, low: float, high: float) -> bool:
        """Certainly not within."""
        return self.high < low or self.low > high

    def over(self, unit: float) -> Interval:
        """In units of something positive that is known."""
        return Interval(self.value / unit, self.low / unit, self.high / unit, self.trials)

    def share(self) -> str:
        """As per cent: ``94.0 % (91.2 to 96.1)``."""
        return f"{100 * self.value:.1f} % ({100 * self.low:.1f} to {100 * self.high:.1f})"


def share(
    hits: BoolArray, groups: IntArray | None = None, confidence: float = CONFIDENCE
) -> Interval:
    """How often ``hits`` (n,) holds true: Wilson's interval.

    With ``groups`` (n,) the number of trials is the effective one, n over the design effect that
    the variance between groups shows (Kish), at least that of the groups and at most n.
    """
    count = len(hits)
    if count == 0:
        return Interval(np.nan, 0.0, 1.0, 0)
    value = float(np.mean(hits))
    trials = float(count if groups is None else _effective(hits, groups))
    z2 = float(norm.ppf(0.5 + 0.5 * confidence)) ** 2
    middle = (value + 0.5 * z2 / trials) / (1.0 + z2 / trials)
    half = np.sqrt(z2 * (value * (1.0 - value) / trials + 0.25 * z2 / trials**2))
    half /= 1.0 + z2 / trials
    # Rounding must not put the figure outside.
    low, high = min(middle - half, value), max(middle + half, value)
    return Interval(value, max(0.0, float(low)), min(1.0, float(high)), count)


def quantile(values: Array, at: float = 0.5, confidence: float = CONFIDENCE) -> Interval:
    """A quantile of independent ``values`` (n,): the interval between two order statistics.

    Infinite values, of trials without a result, count as larger than all others.
    """
    ordered, count = np.sort(values), len(values)
    if count == 0:
        return Interval(np.nan, -np.inf, np.inf, 0)
    tail = 0.5 * (1.0 - confidence)
    below, above = int(binom.ppf(tail, count, at)), int(binom.ppf(1.0 - tail, count, at))
    low = ordered[below - 1] if below > 0 else -np.inf
    high = ordered[above] if above < count else np.inf
    value = np.quantile(ordered, at, method="inverted_cdf")
    return Interval(float(value), float(low), float(high), count)


def bootstrap(
    statistic: Callable[[IntArray], float],
    count: int,
    groups: IntArray | None = None,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> Interval:
    """A positive statistic of the trials (m,) chosen, resampled with replacement, groups as one.

    The interval is that of a normal distribution of its logarithm, with the deviation that
    resampling shows, so that it can be had for any confidence.
    """
    everything = np.arange(count)
    if count == 0:
        return Interval(np.nan, 0.0, np.inf, 0)
    value = statistic(everything)
    if groups is None:
        groups = everything
    members = [np.flatnonzero(groups == group) for group in np.unique(groups)]
    if len(members) < _LEAST_GROUPS:
        return Interval(value, 0.0, np.inf, count)
    rng = np.random.default_rng(seed)
    draws = rng.integers(0, len(members), (_RESAMPLED, len(members)))
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithms = np.log(
            [statistic(np.concatenate([members[k] for k in drawn])) for drawn in draws]
        )
    known = logarithms[np.isfinite(logarithms)]
    if len(known) < 2 or not value > 0.0:
        return Interval(value, 0.0, np.inf, count)
    width = np.exp(norm.ppf(0.5 + 0.5 * confidence) * np.std(known))
    return Interval(value, float(value / width), float(value * width), count)


def together(claims: int, confidence: float = CONFIDENCE) -> float:
    """Confidence of each of several intervals that shall all hold at once (Bonferroni)."""
    return 1.0 - (1.0 - confidence) / max(1, claims)


def _effective(hits: BoolArray, groups: IntArray) -> float:
    value, count = float(np.mean(hits)), len(hits)
    _, which = np.unique(groups, return_inverse=True)
    number = int(which.max()) + 1
    if number < 2 or value in (0.0, 1.0):
        return float(number)
    excess = np.bincount(which, hits - value)  # of hits over those expected of a group
    variance = number / (number - 1) * float(np.sum(excess**2)) / count**2
    if variance == 0.0:
        return float(count)
    return float(np.clip(value * (1.0 - value) / variance, number, count))
