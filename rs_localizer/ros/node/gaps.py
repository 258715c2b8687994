"""Frames that were sent and have not come, by the gaps that they leave between the stamps.

ROS 2 does not number messages, and a best-effort subscription never learns what it has missed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_FEWEST = 8  # intervals of which something can be said
# Intervals count as multiples of the shortest when they are off by less than this part of it.
_LOOSE = 0.2
_MOST_LOOSE = 0.1  # share of intervals that may be further off


def missing(stamps_ns: Sequence[int]) -> int:
    """How many frames are missing between these; 0 where the stamps are not those of a steady rate.

    Args:
        stamps_ns: in the order of arrival.
    """
    intervals = np.diff(np.array(stamps_ns, np.int64)).astype(np.float64)
    intervals = intervals[intervals > 0.0]  # a recording may start over
    if len(intervals) < _FEWEST:
        return 0
    # A few may be shorter than the period: a late stamp, a frame that is sent twice.
    period = float(np.percentile(intervals, 10, method="lower"))
    total = multiples = 0.0
    for interval in np.sort(intervals):  # the longer, the better the period has to be known
        if interval > 0.5 * period:
            total += interval
            multiples += max(round(interval / period), 1)
            period = total / multiples
    found = np.maximum(np.round(intervals / period), 1.0)
    if np.mean(np.abs(intervals / period - found) > _LOOSE) > _MOST_LOOSE:
        return 0
    return int(np.sum(found - 1.0))
