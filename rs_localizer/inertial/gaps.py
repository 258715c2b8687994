# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Where readings go on without a gap, around an interval."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import IntArray
from rs_localizer.core.simd.jit import kernel

# Readings farther apart than so many periods are a gap: one that is missing can be told from its
# neighbours, as far as a vibration goes that they can show, two cannot.
_MOST_PERIODS = 2.5


class Span(NamedTuple):
    """Readings about an interval; times in ns."""

    first: int  # the last one before its start
    last: int  # the first one after its end, and one more
    begin: int  # from here ...
    end: int  # ... to before here there is no gap
    period: float  # median step
    closest: float  # least step
    gap: float  # the longest step in the interval, if that is a gap; else 0


@kernel
def span_of(stamps: IntArray, start_ns: int, end_ns: int) -> Span:
    """How readings (n >= 1), which cover an interval, lie about it."""
    count = len(stamps)
    first, last = 0, count
    steps = np.empty(max(count - 1, 1))
    steps[0] = 0.0
    closest = np.inf
    for i in range(count):
        if stamps[i] <= start_ns:
            first = i
        if i and stamps[i] >= end_ns and last == count:
            last = i + 1
        if i:
            steps[i - 1] = stamps[i] - stamps[i - 1]
            closest = min(closest, steps[i - 1])
    period = float(np.median(steps))
    begin, end, gap = 0, count, 0.0
    for i in range(1, count):
        if steps[i - 1] > _MOST_PERIODS * period:
            if i <= first:
                begin = i
            elif i < last:
                gap = max(gap, steps[i - 1])
            else:
                end = min(end, i)
    return Span(first, last, begin, end, period, closest, gap)
