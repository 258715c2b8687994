# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples of a gyroscope and an accelerometer, by the camera's clock and in its axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, IntArray

MARGIN = 4
"""Samples before and after an interval that the spline through its samples wants to have: what
lies farther away counts less than 0.5 % in it."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuSamples:
    """Samples (n) in the order of their times.

    Raises:
        ValueError: wrong shapes, values that are not finite, times that do not increase.
    """

    times_ns: IntArray  # (n,) camera's clock
    angular_velocity: Array  # (n,3) rad/s, camera axes
    specific_force: Array | None = None  # (n,3) m/s^2, camera axes; upwards at rest

    def __post_init__(self) -> None:
        count = len(self.times_ns)
        times_ns = np.asarray(self.times_ns, np.int64)
        if times_ns.shape != (count,) or not np.all(np.diff(times_ns) > 0):
            raise ValueError("times_ns must be (n,) and increase")
        for name in ("angular_velocity", "specific_force"):
            values = getattr(self, name)
            if values is None:
                continue
            if np.shape(values) != (count, 3) or not np.isfinite(values).all():
                raise ValueError(
                    f"{name} must be ({count},3) and finite, got shape {np.shape(values)}"
                )

    def __len__(self) -> int:
        return len(self.times_ns)

    def around(self, first_ns: int, last_ns: int) -> slice | None:
        """Return samples that cover an interval, with a few on both sides; None if none do."""
        first = int(self.times_ns.searchsorted(first_ns, "right"))
        last = int(self.times_ns.searchsorted(last_ns))
        if first == 0 or last == len(self):
            return None
        return slice(max(first - MARGIN, 0), last + MARGIN)


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


def span_of(stamps: IntArray, start_ns: int, end_ns: int) -> Span:
    """Return how readings (n >= 1), which cover an interval, lie about it."""
    count, steps = len(stamps), np.diff(stamps)
    period, closest = (float(np.median(steps)), float(steps.min())) if count > 1 else (0.0, np.inf)
    first = max(int(stamps.searchsorted(start_ns, "right")) - 1, 0)
    last = min(int(stamps[1:].searchsorted(end_ns)) + 2, count)
    gaps = np.flatnonzero(steps > _MOST_PERIODS * period) + 1  # places of the readings behind them
    inside = gaps[(gaps > first) & (gaps < last)]
    return Span(
        first, last, int(gaps[gaps <= first].max(initial=0)),
        int(gaps[gaps >= last].min(initial=count)), period, closest,
        float(steps[inside - 1].max(initial=0)),
    )  # fmt: skip
