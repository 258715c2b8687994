# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What the gaps between stamps tell of messages that have not come."""

import numpy as np
import pytest

from rs_localizer.ros.node.statistics import missing

RATES = (10.0, 30.0, 60.0)


def stamps(rate: float, count: int, jitter: float, rng: np.random.Generator) -> np.ndarray:
    """ns; jitter as a part of the period."""
    period = 1e9 / rate
    return (np.arange(count) * period + rng.normal(0.0, jitter * period, count)).astype(np.int64)


@pytest.mark.parametrize(
    ("rate", "share"), [(10.0, 0.6), (10.0, 0.9), (30.0, 0.3), (30.0, 0.9), (60.0, 0.2)]
)
def test_what_was_dropped_is_counted(rate, share):
    rng = np.random.default_rng(0)
    sent = stamps(rate, round(5 * rate), 0.02, rng)
    keep = rng.random(len(sent)) < share
    keep[[0, -1]] = True
    assert missing(sent[keep]) == len(sent) - keep.sum()


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("jitter", [0.0, 0.02, 0.05])
def test_a_steady_camera_misses_nothing(rate, jitter):
    for seed in range(20):
        assert missing(stamps(rate, 150, jitter, np.random.default_rng(seed))) == 0


def test_no_rate_no_verdict():
    rng = np.random.default_rng(0)
    triggered = np.cumsum(rng.exponential(1e8, 200)).astype(np.int64)  # whenever something moves
    assert missing(triggered) == 0
    assert missing([]) == missing([5]) == missing([0, 10, 30, 40]) == 0
