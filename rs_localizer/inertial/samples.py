# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples of a gyroscope and an accelerometer: whatever order they come in, those of an exposure.

The buffer is bounded: it remembers some seconds, and never more than a fixed number of samples. Its
methods may be called from any thread.
"""

from __future__ import annotations

import math
import threading
from array import array
from bisect import bisect_left
from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.reasons import ImuReason, Unused

Vector = tuple[float, float, float]

MARGIN = 4
"""Samples before and after an interval that the spline through its samples wants to have: what
lies farther away counts less than 0.5 % in it."""
MEMORY_NS = 3_000_000_000
"""Samples that are older than the newest one by more than this are forgotten."""
MOST = 16_384
"""How many samples are remembered."""
# Samples that come so much behind the newest are no stragglers: the clock was set back.
_SET_BACK_NS = 500_000_000
LONGEST_PERIOD_NS = 16_000_000
"""At a longer period, a shaking of 30 Hz turns by half a cycle between two samples."""
# Samples farther apart than so many periods are a gap: one that is missing can be told from its
# neighbours, as far as a vibration goes that they can show, two cannot.
_MOST_PERIODS = 2.5
# Between samples that are closer than this the noise would make the spline swing: one counts.
_CLOSEST_NS = 250_000
# A gyroscope that shows its greatest value so many times in a row shows the end of its range; one
# that rests, in steps of its resolution, shows no more than this (rad/s).
_SATURATED_COUNT, _SATURATED_RATE = 2, 0.1
# The rate is that of the last samples.
_RATE_COUNT = 64
# Numbers of a sample: rate, force (NaN: it has none), and the greatest rate of each axis so far: by
# the stamps, so that what came early or late in a recording makes no difference.
_WIDTH = 9


@dataclass(frozen=True, slots=True, eq=False)
class ImuSamples:
    """Samples (n) in the order of their times, in the axes of the camera or of the IMU.

    Raises:
        ValueError: for times that do not increase.
    """

    times_ns: IntArray  # (n,) by the clock of the same one, increasing
    angular_velocity: Array  # (n,3) rad/s
    specific_force: Array | None = None  # (n,3) m/s^2, upwards at rest; None: not all have one

    def __post_init__(self) -> None:
        steps = np.diff(self.times_ns)
        if len(steps) and steps.min() <= 0:
            k = int(steps.argmin())
            before, then = self.times_ns[k : k + 2].tolist()
            raise ValueError(f"times_ns must increase, got {then} ns after {before} ns")

    def __len__(self) -> int:
        return len(self.times_ns)

    def around(self, first_ns: int, last_ns: int) -> slice | None:
        """Return samples that cover an interval, with a few on both sides; None if none do."""
        first = int(self.times_ns.searchsorted(first_ns, "right"))
        last = int(self.times_ns.searchsorted(last_ns))
        if first == 0 or last == len(self):
            return None
        return slice(max(first - MARGIN, 0), last + MARGIN)


class SampleBuffer:
    """Takes samples of one IMU as they come, and gives those of an interval."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._stamps, self._values = array("q"), array("d")
        self.frame = ""  # of the samples' axes

    def __len__(self) -> int:
        return len(self._stamps)

    def add(
        self,
        stamp_ns: int,
        frame: str,
        angular_velocity: Vector,
        specific_force: Vector | None = None,
    ) -> None:
        """Take a sample; one of a clock that was set back takes the place of all before."""
        with self._lock:
            stamps, values = self._stamps, self._values
            if frame != self.frame or (stamps and stamp_ns < stamps[-1] - _SET_BACK_NS):
                del stamps[:], values[:]
                self.frame = frame
            place = bisect_left(stamps, stamp_ns)
            if place < len(stamps) and stamps[place] == stamp_ns:
                return
            first = _WIDTH * place
            greatest = map(max, values[first - 3 : first] if place else (0.0,) * 3, map(
                abs, angular_velocity
            ))  # fmt: skip
            row = (*angular_velocity, *(specific_force or (math.nan,) * 3), *greatest)
            stamps.insert(place, stamp_ns)
            values[first:first] = array("d", row)
            old = max(bisect_left(stamps, stamps[-1] - MEMORY_NS), len(stamps) - MOST)
            del stamps[:old], values[: _WIDTH * old]

    def lag(self, stamp_ns: int) -> int:
        """Return the age (ns) of the newest sample at this moment; without one, the moment."""
        with self._lock:
            return stamp_ns - (self._stamps[-1] if self._stamps else 0)

    def rate(self) -> float:
        """Return the samples per second, by the median step; NaN for less than two."""
        return 1e9 / self._period()

    def _period(self) -> float:
        with self._lock:
            steps = np.diff(np.array(self._stamps[-_RATE_COUNT:]))
        return float(np.median(steps)) if len(steps) else math.nan

    def between(
        self, start_ns: int, end_ns: int, since_ns: int | None = None, until_ns: int | None = None
    ) -> ImuSamples | Unused:
        """Return the samples that cover an interval, and those around it.

        Args:
            start_ns, end_ns: of the IMU's clock; from the last sample before to the first after
                it, none may be missing.
            since_ns, until_ns: as far as these go on without a gap.
        """
        since_ns = start_ns if since_ns is None else min(since_ns, start_ns)
        until_ns = end_ns if until_ns is None else max(until_ns, end_ns)
        if (period := self._period()) > LONGEST_PERIOD_NS:
            return Unused(
                ImuReason.TOO_SLOW,
                f"readings come every {_span(period)}; vibration needs one every "
                f"{_span(LONGEST_PERIOD_NS)} at least",
            )
        with self._lock:
            if not len(self):
                return Unused(ImuReason.NEVER, "no message has come")
            outside = _outside(self._stamps[0], self._stamps[-1], start_ns, end_ns)
            if outside is not None:
                return outside
            begin = max(bisect_left(self._stamps, since_ns + 1) - 1, 0)
            end = bisect_left(self._stamps, until_ns) + 1
            stamps = np.array(self._stamps[begin:end])
            values = np.array(self._values[_WIDTH * begin : _WIDTH * end]).reshape(-1, _WIDTH)
        if len(stamps) > 1 and np.diff(stamps).min() < _CLOSEST_NS:
            kept = _apart(stamps)
            stamps, values = stamps[kept], values[kept]
        steps = np.diff(stamps)
        # The interval lies between the samples first and last.
        first = max(int(stamps.searchsorted(start_ns, "right")) - 1, 0)
        last = max(int(stamps.searchsorted(end_ns)), min(first + 1, len(steps)))
        usual = float(np.median(steps)) if len(steps) else 0.0
        gaps, ends = steps > _MOST_PERIODS * usual, _at_the_end_of_the_range(values)
        if gaps[first:last].any():
            longest = float(steps[first:last].max())
            return Unused(ImuReason.GAP, f"no reading for {_span(longest)} within the exposure")
        if ends[first : last + 1].any():
            most = float(np.abs(values[first : last + 1, :3]).max())
            return Unused(ImuReason.SATURATED, f"the gyroscope is saturated at {most:.2f} rad/s")
        # What lies behind a gap, or behind what the gyroscope could not tell, is another story.
        breaks = np.flatnonzero(gaps | ends[1:] | ends[:-1]) + 1
        own = slice(
            int(breaks[breaks <= first].max(initial=0)),
            int(breaks[breaks > last].min(initial=len(stamps))),
        )
        rates, forces = (np.ascontiguousarray(values[own, k : k + 3]) for k in (0, 3))
        lacking = math.isnan(np.add.reduce(forces, axis=None))
        return ImuSamples(stamps[own], rates, None if lacking else forces)


def _outside(oldest: int, newest: int, start_ns: int, end_ns: int) -> Unused | None:
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
    """Return the places of kept samples (n,), so that none is too close to the last."""
    kept = [0]
    for i in range(1, len(stamps)):
        if stamps[i] - stamps[kept[-1]] >= _CLOSEST_NS:
            kept.append(i)
    return np.array(kept)


def _at_the_end_of_the_range(values: Array) -> BoolArray:
    """Return a mask (n,) of samples (n,9) with the greatest rate several times in a row."""
    found, greatest = np.zeros(len(values), np.bool_), values[-1, 6:]
    for axis in np.flatnonzero(greatest >= _SATURATED_RATE):
        same = np.abs(values[:, axis]) == greatest[axis]
        if same.sum() >= _SATURATED_COUNT:
            row = np.ones(_SATURATED_COUNT)
            begins = np.convolve(same, row, "valid") >= _SATURATED_COUNT
            found |= np.convolve(begins, row) > 0.0
    return found


def _span(nanoseconds: float) -> str:
    return f"{1e-6 * nanoseconds:.1f} ms" if nanoseconds < 1e9 else f"{1e-9 * nanoseconds:.1f} s"
