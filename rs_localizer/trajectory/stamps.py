"""Whether the stamps of images are those of a camera that runs evenly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array

# A camera's own clock keeps its stamps within this (s) of even intervals.
_MOST_JITTER = 5e-4


@dataclass(frozen=True, slots=True, eq=False)
class Stamps:
    """Images of a camera that should run evenly."""

    interval: float  # s
    jitter: float  # s rms, of the stamps about even intervals
    missing: int  # images

    @property
    def irregular(self) -> bool:
        return self.jitter > _MOST_JITTER


def examine(times: Array) -> Stamps:
    """Even intervals nearest to the stamps (f,), s, sorted.

    The number of intervals is counted from stamp to stamp, so that images may be missing.
    """
    steps = np.diff(times)
    interval = float(np.median(steps))
    for _ in range(3):
        counts = np.maximum(np.round(steps / interval), 1.0)
        number = np.concatenate([[0.0], np.cumsum(counts)])
        rate = np.polyfit(number, times, 1)
        interval = float(rate[0])
    even = np.polyval(rate, number)
    off = times - even
    jitter = float(np.sqrt(np.mean((off - np.median(off)) ** 2)))
    return Stamps(interval, jitter, int(number[-1]) + 1 - len(times))
