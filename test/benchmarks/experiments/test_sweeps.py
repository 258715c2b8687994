"""Quartiles, crossings and differences of curves."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.experiments import methods as m
from benchmarks.experiments.sweeps import (
    Curves,
    crossing,
    largest_difference,
    quartiles,
    sampled,
)


def curves(**medians: list[list[float]]) -> Curves:
    """Curves with these medians, two places."""
    found = {name: np.stack([0.5 * np.array(v), v, 2.0 * np.array(v)], axis=1)
             for name, v in medians.items()}  # fmt: skip
    return Curves("x", np.array([1.0, 2.0]), found)


def test_quartiles_survive_infinite_errors() -> None:
    errors = np.array([[1.0], [2.0], [3.0], [4.0], [np.inf]])
    np.testing.assert_array_equal(quartiles(errors), [[2.0], [3.0], [4.0]])
    assert np.isinf(quartiles(np.full((5, 1), np.inf))).all()


def test_crossing_is_interpolated() -> None:
    x = np.array([0.0, 10.0, 20.0])
    level = np.ones(3)
    assert crossing(x, np.array([0.0, 0.5, 2.5]), level) == pytest.approx(12.5)
    assert crossing(x, np.array([2.0, 3.0, 4.0]), level) == 0.0
    assert np.isnan(crossing(x, np.array([0.0, 0.1, 0.2]), level))


def test_differences_below_the_floor_do_not_count() -> None:
    one, other = np.array([1.0, 1e-12]), np.array([1.1, 3e-12])
    assert largest_difference(one, other, np.array([1e-9, 1e-9])) == pytest.approx(0.1 / 1.1)
    assert largest_difference(one, other, np.array([0.0, 0.0])) == pytest.approx(2.0 / 3.0)


def test_the_table_has_a_row_per_curve_and_metric() -> None:
    table = curves(p3p=[[1, 2, 3, 4], [5, 6, 7, 8]]).table()
    assert table.columns == ("x", "method", "metric", "p25", "median", "p75")
    assert len(table.rows) == 2 * 4
    assert table.rows[5] == (2.0, "p3p", "position", 3.0, 6.0, 12.0)


def test_curves_by_method() -> None:
    found = curves(p3p=[[1, 2, 3, 4], [5, 6, 7, 8]])
    assert found.has(m.P3P)
    assert not found.has(m.P3P, m.R9P)
    assert found.at(m.P3P, 1, 2.0) == 6.0
    np.testing.assert_array_equal(found.median(m.P3P, 0), [1.0, 5.0])


def drawn(trials: int, ratio: float, seed: int) -> Curves:
    """Two methods whose true medians differ by a ratio, at ten places."""
    rng = np.random.default_rng(seed)
    errors = {
        name: scale * rng.exponential(size=(10, trials, 4))
        for name, scale in (("one", 1.0), ("other", ratio))
    }
    found = {
        name: np.array([quartiles(each) for each in values]) for name, values in errors.items()
    }
    return Curves("x", np.arange(10.0), found, errors)


def excess(curves: Curves) -> float:
    """The largest of many ratios, which noise makes larger."""
    return float(np.max(curves.quartiles["other"][:, 1] / curves.quartiles["one"][:, 1]))


def test_the_largest_of_many_ratios_is_not_taken_for_a_difference() -> None:
    below = [sampled(excess, drawn(200, 1.0, seed)) for seed in range(20)]
    # Every one looks 10 % off, and hardly one is.
    assert min(interval.value for interval in below) > 1.1
    assert np.mean([interval.outside(-np.inf, 1.1) for interval in below]) <= 0.1
    assert sampled(excess, drawn(200, 2.0, 0)).outside(-np.inf, 1.1)
    assert sampled(excess, drawn(20000, 1.0, 0)).within(-np.inf, 1.1)


def test_a_figure_without_trials_is_exact() -> None:
    known = drawn(50, 1.0, 0)
    bare = Curves(known.x_name, known.x, known.quartiles)
    found = sampled(excess, bare)
    assert found.low == found.value == found.high
