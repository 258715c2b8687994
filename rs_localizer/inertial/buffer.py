# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Inertial readings by their stamps: whatever order they come in, those of an exposure.

Bounded: it remembers some seconds, and never more than a fixed number of readings. Methods may be
called from any thread.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.reasons import ImuReason
from rs_localizer.inertial.samples import span_of
from rs_localizer.inertial.status import Unused

Vector = tuple[float, float, float]

MEMORY_NS = 3_000_000_000
"""For how long readings are remembered, before the newest."""
MOST = 16_384
"""How many readings are remembered."""
# Readings that come so much behind the newest are no stragglers: the clock was set back.
_SET_BACK_NS = 500_000_000
LONGEST_PERIOD_NS = 16_000_000
"""At a longer period, a shaking of 30 Hz turns by half a cycle between two readings."""
# Between readings that are closer than this the noise would make the spline swing: one counts.
_CLOSEST_NS = 250_000
# A gyroscope that shows its greatest value so many times in a row shows the end of its range; one
# that rests, in steps of its resolution, shows no more than this (rad/s).
_SATURATED_COUNT, _SATURATED_RATE = 2, 0.1
# The rate is that of the last readings.
_RATE_COUNT = 64


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """Readings without a gap, in the axes of the IMU."""

    stamps_ns: IntArray  # (n,) by the IMU's clock, increasing
    angular_velocities: Array  # (n,3) rad/s
    specific_forces: Array | None  # (n,3) m/s^2; None: not all have one


class ReadingBuffer:
    """Takes readings as they come, and gives those of an interval."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # The readings stand from _first to _last; at the end of the arrays they move to the front.
        self._stamps = np.zeros(2 * MOST, np.int64)
        # Rate, force (NaN: it has none), and the greatest rate of each axis so far: by the stamps,
        # so that what came early or late in a recording makes no difference.
        self._values = np.zeros((2 * MOST, 9))
        self._first = self._last = 0
        self.frame = ""  # of the readings' axes

    def __len__(self) -> int:
        return self._last - self._first

    def add(
        self,
        stamp_ns: int,
        frame: str,
        angular_velocity: Vector,
        specific_force: Vector | None = None,
    ) -> None:
        """Take a reading; one of a clock that was set back takes the place of all before."""
        with self._lock:
            newest = int(self._stamps[self._last - 1]) if len(self) else stamp_ns
            if stamp_ns < newest - _SET_BACK_NS or frame != self.frame:
                self._first = self._last = 0
                self.frame = frame
            place = self._insert(stamp_ns)
            if place is not None:
                row = self._values[place]
                row[:3] = angular_velocity
                row[3:6] = np.nan if specific_force is None else specific_force
                row[6:] = np.abs(row[:3])
                if place > self._first:
                    np.maximum(row[6:], self._values[place - 1, 6:], out=row[6:])

    def _insert(self, stamp_ns: int) -> int | None:
        """Make room for a reading: its row; None where its stamp is there already."""
        if self._last == len(self._stamps):
            self._compact()
        place = self._last
        if len(self) and stamp_ns <= self._stamps[place - 1]:  # mostly it is the newest
            known = self._stamps[self._first : self._last]
            place = self._first + int(known.searchsorted(stamp_ns))
            if self._stamps[place] == stamp_ns:
                return None
            for array in (self._stamps, self._values):
                array[place + 1 : self._last + 1] = array[place : self._last].copy()
        self._stamps[place] = stamp_ns
        self._last += 1
        return place

    def _compact(self) -> None:
        first = max(self._oldest(), self._last - MOST)
        count = self._last - first
        for array in (self._stamps, self._values):
            array[:count] = array[first : self._last].copy()
        self._first, self._last = 0, count

    def _oldest(self) -> int:
        """Return the row of the first reading that is remembered."""
        stamps = self._stamps[self._first : self._last]
        return self._first + int(stamps.searchsorted(stamps[-1] - MEMORY_NS))

    def lag(self, stamp_ns: int) -> int:
        """Return the age (ns) of the newest reading at this moment; without one, the moment."""
        with self._lock:
            return stamp_ns - (int(self._stamps[self._last - 1]) if len(self) else 0)

    def rate(self) -> float:
        """Return the readings per second, by the median step; NaN for less than two."""
        with self._lock:
            steps = np.diff(self._stamps[self._first : self._last][-_RATE_COUNT:])
        return 1e9 / float(np.median(steps)) if len(steps) else math.nan

    def between(
        self, start_ns: int, end_ns: int, since_ns: int | None = None, until_ns: int | None = None
    ) -> Readings | Unused:
        """Return the readings that cover an interval, and those around it.

        Args:
            start_ns, end_ns: of the IMU's clock; from the last reading before to the first after
                it, none may be missing.
            since_ns, until_ns: as far as these go on without a gap.
        """
        since_ns = start_ns if since_ns is None else min(since_ns, start_ns)
        until_ns = end_ns if until_ns is None else max(until_ns, end_ns)
        with self._lock:
            if not len(self):
                return Unused(ImuReason.NEVER, "no message has come")
            self._first = self._oldest()
            known = self._stamps[self._first : self._last]
            if (outside := _outside(known, start_ns, end_ns)) is not None:
                return outside
            begin = max(int(known.searchsorted(since_ns, "right")) - 1, 0)
            end = min(int(known.searchsorted(until_ns)) + 1, len(known))
            stamps = known[begin:end].copy()
            values = self._values[self._first + begin : self._first + end].copy()
        span = span_of(stamps, start_ns, end_ns)
        if span.closest < _CLOSEST_NS:
            kept = _apart(stamps)
            stamps, values = stamps[kept], values[kept]
            span = span_of(stamps, start_ns, end_ns)
        if span.period > LONGEST_PERIOD_NS:
            return Unused(
                ImuReason.TOO_SLOW,
                f"readings come every {_span(span.period)}; vibration needs one every "
                f"{_span(LONGEST_PERIOD_NS)} at least",
            )
        if span.gap:
            step = _span(span.gap)
            return Unused(ImuReason.GAP, f"no reading for {step} within the exposure")
        begin, end = span.begin, span.end
        greatest = values[-1, 6:]
        if greatest.max() >= _SATURATED_RATE:
            ends = _at_the_end_of_the_range(values[:, :3], greatest)
            if np.any(ends[span.first : span.last]):
                most = float(np.abs(values[span.first : span.last, :3]).max())
                return Unused(
                    ImuReason.SATURATED,
                    f"the gyroscope is saturated at {most:.2f} rad/s",
                )
            # Cut on both sides of what it could not tell.
            stops = np.concatenate([np.flatnonzero(ends), np.flatnonzero(ends) + 1])
            begin = max([begin, *stops[stops <= span.first].tolist()])
            end = min([end, *stops[stops >= span.last].tolist()])
        rates = np.ascontiguousarray(values[begin:end, :3])
        forces = np.ascontiguousarray(values[begin:end, 3:6])
        lacking = math.isnan(np.add.reduce(forces, axis=None))
        return Readings(stamps[begin:end], rates, None if lacking else forces)


def _outside(stamps: IntArray, start_ns: int, end_ns: int) -> Unused | None:
    oldest, newest = int(stamps[0]), int(stamps[-1])
    if start_ns < oldest:
        return Unused(
            ImuReason.BEGINS_LATER,
            f"the first reading is {_span(oldest - start_ns)} younger than the first row: a late "
            "start, or another clock",
        )
    if newest < start_ns - _SET_BACK_NS:
        return Unused(
            ImuReason.STOPPED,
            f"the last reading is {_span(start_ns - newest)} older than the first row: the IMU "
            "stopped, or has another clock",
        )
    if newest < end_ns:
        return Unused(
            ImuReason.LATE, f"the last reading is {_span(end_ns - newest)} older than the last row"
        )
    return None


def _apart(stamps: IntArray) -> IntArray:
    """Return the places of kept readings (n,), so that none is too close to the last."""
    kept = [0]
    for i in range(1, len(stamps)):
        if stamps[i] - stamps[kept[-1]] >= _CLOSEST_NS:
            kept.append(i)
    return np.array(kept)


def _at_the_end_of_the_range(rates: Array, greatest: Array) -> BoolArray:
    """Return a mask (n,) of readings (n,3) with the greatest value several times in a row."""
    found = np.zeros(len(rates), np.bool_)
    for axis in np.flatnonzero(greatest >= _SATURATED_RATE):
        same = np.abs(rates[:, axis]) == greatest[axis]
        if same.sum() >= _SATURATED_COUNT:
            row = np.ones(_SATURATED_COUNT)
            begins = np.convolve(same, row, "valid") >= _SATURATED_COUNT
            found |= np.convolve(begins, row) > 0.0
    return found


def _span(nanoseconds: float) -> str:
    return f"{1e-6 * nanoseconds:.1f} ms" if nanoseconds < 1e9 else f"{1e-9 * nanoseconds:.1f} s"
