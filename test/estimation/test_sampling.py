# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rs_localizer.estimation.ransac import Pool, draw, generator


def samples_of(pool, count, size, tau=None, seed=0, prefixes=None):
    tau = np.linspace(-0.5, 0.5, 1000) if tau is None else tau
    samples = np.full((count, size), -1, dtype=np.int64)
    if prefixes is None:
        prefixes = np.full(count, len(pool), dtype=np.int64)
    draw(np.asarray(pool, np.int64), prefixes, tau, float(np.ptp(tau)), generator(seed), samples)
    return samples


@given(st.integers(6, 40), st.integers(1, 6), st.integers(0, 2**31 - 1))
def test_samples_are_distinct_points_of_the_pool(total, size, seed):
    pool = np.arange(total) * 7
    samples = samples_of(pool, 20, size, seed=seed)
    assert np.isin(samples, pool).all()
    assert all(len(set(sample)) == size for sample in samples)


def test_all_points_are_drawn_equally_often():
    pool = np.random.default_rng(0).permutation(1000)[:50]
    counts = np.bincount(samples_of(pool, 20000, 6).ravel(), minlength=1000)[pool]
    expected = 20000 * 6 / 50
    # Five standard deviations of a count.
    assert np.abs(counts - expected).max() < 5 * np.sqrt(expected)


def test_the_seed_decides_and_nothing_else():
    pool = np.arange(100)
    first, again, other = (samples_of(pool, 10, 6, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_samples_spread_over_the_rows_where_they_can():
    tau = np.concatenate([np.full(90, 0.1), np.linspace(-0.5, 0.5, 10)])
    spread = np.ptp(tau[samples_of(np.arange(100), 1000, 6, tau)], axis=1)
    without = np.ptp(
        tau[np.array([np.random.default_rng(k).choice(100, 6, False) for k in range(1000)])], axis=1
    )
    assert np.mean(spread < 0.25) < 0.2 * np.mean(without < 0.25)
    # Where all rows are the same, samples come nevertheless.
    assert (samples_of(np.arange(10), 5, 6, np.zeros(10)) >= 0).all()


def test_ranked_pools_begin_with_the_best_and_end_with_all():
    pool = Pool(np.arange(200), 1.0, ranked=True)
    sizes = pool.prefix_sizes(0, 1000, 6)
    assert sizes[0] < 40
    assert pool.prefix_sizes(200_000, 1, 6) == 200
    assert (np.diff(sizes) >= 0).all()
    np.testing.assert_array_equal(
        sizes, np.concatenate([pool.prefix_sizes(k, 100, 6) for k in range(0, 1000, 100)])
    )
    samples = samples_of(pool.points, 1000, 6, prefixes=sizes)
    assert (samples.max(axis=1) < sizes).all()


def test_unranked_and_tiny_pools_are_used_whole():
    assert (Pool(np.arange(50), 1.0).prefix_sizes(0, 10, 6) == 50).all()
    assert (Pool(np.arange(6), 1.0, ranked=True).prefix_sizes(0, 10, 6) == 6).all()
