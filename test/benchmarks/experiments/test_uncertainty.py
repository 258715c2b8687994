"""Intervals hold what they promise, and verdicts are read off them."""

import numpy as np
import pytest

from benchmarks.experiments.results import Statement, Verdict
from benchmarks.experiments.uncertainty import Interval, bootstrap, quantile, share, together


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


def test_frames_of_one_recording_count_less():
    rng = np.random.default_rng(0)
    groups = np.repeat(np.arange(40), 5)
    alike = np.repeat(rng.random(40) < 0.8, 5)
    apart = rng.random(200) < 0.8
    width = {name: np.ptp([share(x, groups).low, share(x, groups).high])
             for name, x in (("alike", alike), ("apart", apart))}  # fmt: skip
    plain = share(alike)
    assert width["alike"] > 1.8 * (plain.high - plain.low)
    assert width["apart"] < 1.4 * (plain.high - plain.low)


@pytest.mark.bench
def test_intervals_hold_the_true_figures():
    rng = np.random.default_rng(1)
    held = {"share": [], "grouped": [], "median": [], "ratio": []}
    groups = np.repeat(np.arange(40), 5)
    for _ in range(300):
        chance = np.repeat(rng.beta(8.0, 2.0, 40), 5)
        grouped = share(rng.random(200) < chance, groups)
        held["grouped"].append(grouped.low <= 0.8 <= grouped.high)
        plain = share(rng.random(100) < 0.9)
        held["share"].append(plain.low <= 0.9 <= plain.high)
        middle = quantile(rng.exponential(size=60))
        held["median"].append(middle.low <= np.log(2.0) <= middle.high)
    for _ in range(60):
        errors = rng.exponential(size=(2, 100)) * [[2.0], [1.0]]
        ratio = bootstrap(
            lambda chosen, errors=errors: float(np.divide(*np.median(errors[:, chosen], axis=1))),
            100,
        )
        held["ratio"].append(ratio.low <= 2.0 <= ratio.high)
    for name, each in held.items():
        assert np.mean(each) > 0.9, name


def test_the_median_of_trials_without_result_is_infinite():
    found = quantile(np.array([1.0] * 30 + [np.inf] * 70))
    assert found.value == found.high == np.inf
    few = quantile(np.array([1.0, 2.0, np.inf]))
    assert (few.value, few.low, few.high) == (2.0, -np.inf, np.inf)


def test_several_intervals_are_wider():
    assert together(1) == pytest.approx(0.95)
    assert together(10) == pytest.approx(0.995)
    assert share(hits(9, 10), confidence=together(10)).low < share(hits(9, 10)).low


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
