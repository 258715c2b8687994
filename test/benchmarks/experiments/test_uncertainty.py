# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Intervals hold what they promise, and verdicts are read off them."""

import numpy as np
import pytest

from benchmarks.experiments.results import Statement, Verdict
from benchmarks.experiments.uncertainty import Interval, share


def hits(count: int, trials: int) -> np.ndarray:
    return np.arange(trials) < count


@pytest.mark.parametrize(
    ("count", "trials", "low", "high"),
    # Wilson's interval as published (Newcombe 1998, method 3).
    [
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_shares(count, trials, low, high):
    found = share(hits(count, trials))
    assert (found.low, found.high) == pytest.approx((low, high), abs=6e-5)
    assert found.trials == trials


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (0.93, 0.97, Verdict.HELD),
        (0.90, 0.97, Verdict.UNDECIDED),
        (0.80, 0.90, Verdict.NOT_HELD),
        (0.985, 0.99, Verdict.NOT_HELD),
    ],
)
def test_verdicts(low, high, verdict):
    certain = Interval(0.95, 0.94, 0.96, 1000)
    own = Interval(0.5 * (low + high), low, high, 60)
    claim = Statement("a.b", "s", "c", "d").judged_by(
        "found", [certain, own], (0.92, 0.98), "no luck"
    )
    assert claim.verdict is verdict
    assert ("undecided at 60 trials" in claim.finding) == (verdict is Verdict.UNDECIDED)
    assert claim.why == ("no luck" if verdict is Verdict.NOT_HELD else "")
