"""Inertial readings by their stamps: whatever order they come in, those of an exposure.

Bounded: it remembers some seconds, and never more than a fixed number of readings. Methods may be
called from any thread.
"""

from __future__ import annotations

import threading
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from rs_localizer.core.arrays import Array, IntArray

Vector = tuple[float, float, float]

MEMORY_NS = 3_000_000_000
"""For how long readings are remembered, before the newest."""
_MOST = 8192
# Readings that come so much behind the newest are no stragglers: the clock was set back.
_SET_BACK_NS = 500_000_000
# Readings farther apart than this leave parts of an exposure unseen: a shaking of 30 Hz turns by
# half a cycle meanwhile.
_LARGEST_STEP_NS = 16_000_000
# A gyroscope that shows its greatest value so many times in a row, and at least this (rad/s; the
# smallest range there is), shows the end of its range.
_SATURATED_COUNT, _SATURATED_RATE = 4, 2.0


class Lack(StrEnum):
    """Why there are no readings of an exposure."""

    NEVER = "never"  # none has come so far
    NOT_YET = "not_yet"  # the newest is of before its end, and others may follow
    STOPPED = "stopped"  # the newest is of long before its beginning
    TOO_LATE = "too_late"  # the oldest that is remembered is of after its beginning
    GAP = "gap"  # some have been lost
    TOO_SLOW = "too_slow"  # they come at too low a rate
    SATURATED = "saturated"  # the camera turns faster than the gyroscope can tell


@dataclass(frozen=True, slots=True)
class Lacking:
    """No readings, with one sentence that says what was found; false in a condition."""

    lack: Lack
    detail: str

    def __bool__(self) -> bool:
        return False


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """From the last reading before an interval to the first one after it, in the IMU's axes."""

    frame: str
    stamps_ns: IntArray  # (n,) by the IMU's clock, increasing
    angular_velocities: Array  # (n,3) rad/s
    specific_forces: Array | None  # (n,3) m/s^2; None: not all have one
    gyroscope_deviation: float | None  # rad/s, of one axis of one reading; None: not told


@dataclass(frozen=True, slots=True)
class _Item:
    frame: str
    angular_velocity: Vector
    specific_force: Vector | None
    deviation: float | None


class ReadingBuffer:
    """Takes readings as they come, and gives those of an interval."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._stamps: list[int] = []
        self._items: list[_Item] = []
        self._greatest = [0.0, 0.0, 0.0]  # rad/s on each axis, so far
        self.repeated = 0  # readings with a stamp that was there already
        self.jumps = 0  # times that the clock was set back

    def __len__(self) -> int:
        return len(self._stamps)

    def clear(self) -> None:
        """Forget all readings."""
        with self._lock:
            self._stamps, self._items = [], []

    def add(
        self,
        stamp_ns: int,
        frame: str,
        angular_velocity: Vector,
        specific_force: Vector | None = None,
        deviation: float | None = None,
    ) -> bool:
        """Take a reading; whether it went on in time, and the clock was not set back."""
        item = _Item(frame, angular_velocity, specific_force, deviation)
        with self._lock:
            set_back = bool(self._stamps) and stamp_ns < self._stamps[-1] - _SET_BACK_NS
            if set_back or (self._items and self._items[-1].frame != frame):
                self._stamps, self._items = [], []
                self.jumps += set_back
            place = bisect_left(self._stamps, stamp_ns)  # mostly the end
            if place < len(self._stamps) and self._stamps[place] == stamp_ns:
                self.repeated += 1
                return not set_back
            self._stamps.insert(place, stamp_ns)
            self._items.insert(place, item)
            self._trim()
            self._greatest = [
                max(most, abs(value))
                for most, value in zip(self._greatest, angular_velocity, strict=True)
            ]
            return not set_back

    def _trim(self) -> None:
        # In blocks, so that each reading is moved once on the average.
        stamps = self._stamps
        if len(stamps) < 2 * _MOST and stamps[-1] - stamps[0] < 2 * MEMORY_NS:
            return
        first = max(bisect_left(stamps, stamps[-1] - MEMORY_NS), len(stamps) - _MOST)
        del self._stamps[:first], self._items[:first]

    def latest_ns(self) -> int | None:
        """The newest stamp."""
        with self._lock:
            return self._stamps[-1] if self._stamps else None

    def rate(self) -> float:
        """Readings per second, by the median of the steps; NaN for less than two."""
        with self._lock:
            period = _period(self._stamps)
        return 1e9 / period if period else float("nan")

    def between(self, start_ns: int, end_ns: int) -> Readings | Lacking:
        """The readings that cover an interval of the IMU's clock, its ends included."""
        with self._lock:
            if not self._stamps:
                return Lacking(Lack.NEVER, "no message has come")
            if (lacking := self._outside(start_ns, end_ns)) is not None:
                return lacking
            first = bisect_right(self._stamps, start_ns) - 1
            last = bisect_left(self._stamps, end_ns) + 1
            stamps, items = self._stamps[first:last], self._items[first:last]
            greatest, period = list(self._greatest), _period(self._stamps)
        rates = np.array([item.angular_velocity for item in items])
        steps = np.diff(stamps)
        if len(steps) and steps.max() > _LARGEST_STEP_NS:
            return _sparse(float(steps.max()), period)
        if (axis := _saturated(rates, greatest)) is not None:
            return Lacking(
                Lack.SATURATED,
                f"the gyroscope shows {greatest[axis]:.2f} rad/s on its axis {'xyz'[axis]}, and no "
                "more: the end of its range",
            )
        forces = [item.specific_force for item in items]
        return Readings(
            frame=items[-1].frame,
            stamps_ns=np.array(stamps, np.int64),
            angular_velocities=rates,
            specific_forces=None if None in forces else np.array(forces, np.float64),
            gyroscope_deviation=items[-1].deviation,
        )

    def _outside(self, start_ns: int, end_ns: int) -> Lacking | None:
        oldest, newest = self._stamps[0], self._stamps[-1]
        if start_ns < oldest:
            return Lacking(
                Lack.TOO_LATE,
                f"the first reading is {_span(oldest - start_ns)} younger than the first row (did "
                "it begin later, or has it another clock?)",
            )
        if newest < start_ns - _SET_BACK_NS:
            return Lacking(
                Lack.STOPPED,
                f"the last reading is {_span(start_ns - newest)} older than the first row (has it "
                "stopped, or has it another clock?)",
            )
        if newest < end_ns:
            return Lacking(
                Lack.NOT_YET,
                f"the last reading is {_span(end_ns - newest)} older than the last row",
            )
        return None


def _sparse(step: float, period: float) -> Lacking:
    if period > _LARGEST_STEP_NS:
        return Lacking(
            Lack.TOO_SLOW,
            f"a reading comes every {_span(period)}; at most {_span(_LARGEST_STEP_NS)} tell how "
            "a camera shakes",
        )
    return Lacking(Lack.GAP, f"for {_span(step)} within the exposure there is no reading")


def _period(stamps: Sequence[int]) -> float:
    """Median step in ns of the last readings; 0 for less than two."""
    return float(np.median(np.diff(stamps[-64:]))) if len(stamps) > 1 else 0.0


def _saturated(rates: Array, greatest: Sequence[float]) -> int | None:
    """The axis on which the greatest value so far stands in a row, if there is one."""
    for axis in range(3):
        if greatest[axis] < _SATURATED_RATE:
            continue
        at_end = np.abs(rates[:, axis]) == greatest[axis]
        if at_end.sum() >= _SATURATED_COUNT:
            run = np.convolve(at_end, np.ones(_SATURATED_COUNT), "valid")
            if len(run) and run.max() >= _SATURATED_COUNT:
                return axis
    return None


def _span(nanoseconds: float) -> str:
    return f"{1e-6 * nanoseconds:.1f} ms" if nanoseconds < 1e9 else f"{1e-9 * nanoseconds:.1f} s"
