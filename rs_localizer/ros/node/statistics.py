# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Statistics of frames: totals since the start, and of the last seconds."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Generic, TypeVar

import numpy as np

from rs_localizer.io.messages import stamp_ns
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.ros.node.refusals import Refusals

_FEWEST = 8  # intervals of which something can be said
# Intervals count as multiples of the shortest when they are off by less than this part of it.
_LOOSE = 0.2
_MOST_LOOSE = 0.1  # share of intervals that may be further off
WINDOW = 5.0
"""Seconds of the past that rates and shares are counted over."""


def missing(stamps_ns: Sequence[int]) -> int:
    """Return the number of frames missing between stamps; 0 if their rate is not steady.

    Args:
        stamps_ns: in the order of arrival.
    """
    intervals = np.diff(np.array(stamps_ns, np.int64)).astype(np.float64)
    # A recording may start over, or a clock be set: no frame of now was awaited for so long.
    intervals = intervals[(intervals > 0.0) & (intervals < 1e9 * WINDOW)]
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
    counts = np.maximum(np.round(intervals / period), 1.0)
    if np.mean(np.abs(intervals / period - counts) > _LOOSE) > _MOST_LOOSE:
        return 0
    return int(np.sum(counts - 1.0))


Result = TypeVar("Result")

# Events that are remembered; a window of faster cameras is shorter.
_MOST_EVENTS = 8192
# A header's stamp that is older (s), or in the future, was made by another clock.
_OLDEST_STAMP = 10.0

Percentiles = tuple[float, float]  # s, the median and the 95th


class Event(StrEnum):
    """Fate of a frame."""

    RECEIVED = "received"
    ANSWERED = "answered"
    REFUSED = "refused"
    REPLACED = "replaced"  # by a newer one, before it was looked at
    DROPPED = "dropped"  # because the node was deactivated


@dataclass(frozen=True, slots=True)
class Told:
    """Words on a frame that was answered."""

    state: str
    text: str  # one sentence
    values: dict[str, str]  # by readable names


@dataclass(frozen=True, slots=True)
class Summary:
    """State of the frames now."""

    total: Mapping[Event, int]  # frames since the start
    lately: Mapping[Event, int]  # in the window
    reasons: dict[str, int]  # of refusals since the start, also of messages that are no frames
    recent_reasons: Mapping[str, int]  # of frames
    rate_in: float  # Hz
    rate_out: float  # Hz
    recently_missing: int  # sent and not received, by the gaps between the stamps
    refused_since_answer: int  # frames in a row
    busy: float | None  # s for which the worker has had the same frame
    latency: Percentiles | None  # from receiving to publishing
    delay: Percentiles | None  # from the header's stamp to publishing, where that makes sense
    last: Told | None  # of the last frame that was answered; None: there was none


class Statistics(Generic[Result]):
    """Counts frames; all methods may be called from any thread.

    Args:
        refusals: logs and counts refusals.
        tell: stamp of the frame (ns) and what is told of a result.
        ros_time: now in ns, by the clock of the stamps.
        clock: s, monotonic.
    """

    def __init__(
        self,
        refusals: Refusals,
        tell: Callable[[Result], tuple[int, Told]],
        ros_time: Callable[[], int] = time.time_ns,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._refusals, self._tell = refusals, tell
        self._ros_time, self._clock = ros_time, clock
        self._lock = threading.Lock()
        self._total: Counter[Event] = Counter()
        self._in_a_row = 0
        self._last: Told | None = None
        self._started: float | None = None
        # When what happened, with a stamp (topic, ns), a reason, or latency and delay in s.
        self._events: deque[tuple[float, Event, Any]] = deque(maxlen=_MOST_EVENTS)

    def count(self, event: Event, what: Any = None, count: int = 1) -> None:
        """Count what became of frames.

        Args:
            what: of one that has come its topic and stamp (ns), of a refusal its reason, of an
                answer its latency and delay (s).
        """
        with self._lock:
            self._total[event] += count
            self._events.append((self._clock(), event, what))
            if event in (Event.REFUSED, Event.ANSWERED):
                self._in_a_row = self._in_a_row + 1 if event is Event.REFUSED else 0

    def received(self, topic: str, message: Any) -> None:
        """Count a frame that has come, a message with a header."""
        self.count(Event.RECEIVED, (topic, stamp_ns(message)))

    def restart(self) -> None:
        """Forget frames before a jump of time: they are not compared with later ones."""
        with self._lock:
            self._events.clear()

    def started(self) -> None:
        """Note that the worker has taken a frame."""
        self._started = self._clock()

    def ended(self) -> None:
        self._started = None

    def refused(self, refusal: Refusal) -> None:
        self.count(Event.REFUSED, refusal.reason)
        self._refusals.add(refusal.reason, refusal.detail)

    def answered(self, result: Result, received: float) -> None:
        """Count a published result of a frame that was received at this time of the clock."""
        input_stamp_ns, self._last = self._tell(result)
        delay = (self._ros_time() - input_stamp_ns) * 1e-9
        self.count(Event.ANSWERED, (self._clock() - received, delay))

    def summary(self) -> Summary:
        """Return the state of the frames now."""
        with self._lock:
            now, started = self._clock(), self._started
            recent = [item for item in self._events if item[0] >= now - WINDOW]
            total, last, in_a_row = Counter(self._total), self._last, self._in_a_row

        def of(event: Event) -> list[tuple[float, Any]]:
            return [(when, what) for when, each, what in recent if each is event]

        came, out = of(Event.RECEIVED), of(Event.ANSWERED)
        topics = {topic for _, (topic, _) in came}
        return Summary(
            total=total,
            lately=Counter(event for _, event, _ in recent),
            reasons=dict(self._refusals.counts),
            recent_reasons=Counter(reason for _, reason in of(Event.REFUSED)),
            rate_in=_rate([when for when, _ in came]),
            rate_out=_rate([when for when, _ in out]),
            recently_missing=sum(
                missing([stamp for _, (topic, stamp) in came if topic == one]) for one in topics
            ),
            refused_since_answer=in_a_row,
            busy=None if started is None else now - started,
            latency=_percentiles([latency for _, (latency, _) in out]),
            delay=_percentiles([d for _, (_, d) in out if 0.0 <= d <= _OLDEST_STAMP]),
            last=last,
        )


def _rate(times: list[float]) -> float:
    """Return the rate (Hz) of these times; one moment has none."""
    span = times[-1] - times[0] if times else 0.0
    return (len(times) - 1) / span if span > 0.0 else 0.0


def _percentiles(values: list[float]) -> Percentiles | None:
    if not values:
        return None
    median, high = np.percentile(values, (50, 95)).tolist()
    return median, high
