# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What became of the frames: totals since the start, and how things are now."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from rs_localizer.io.messages import stamp_ns
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.ros.node.refusals import Refusals

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
    counts = np.maximum(np.round(intervals / period), 1.0)
    if np.mean(np.abs(intervals / period - counts) > _LOOSE) > _MOST_LOOSE:
        return 0
    return int(np.sum(counts - 1.0))


Result = TypeVar("Result")
Kept = TypeVar("Kept")

WINDOW = 5.0
"""What "now" means, in s."""

# Frames that are remembered; a window of faster cameras is shorter.
_MOST_FRAMES = 2048
# A header's stamp that is older (s), or in the future, was made by another clock.
_OLDEST_STAMP = 10.0

Percentiles = tuple[float, float]  # s, the median and the 95th


@dataclass(frozen=True, slots=True)
class Summary(Generic[Kept]):
    """How things are now."""

    received: dict[str, int]  # frames since the start, by topic
    answered: int
    replaced: int
    dropped: int  # because the node was deactivated
    refused: int
    refusals: dict[str, int]  # also of messages that are no frames, by reason
    rate_in: float  # Hz
    rate_out: float  # Hz
    recently_received: int  # in the window
    recently_replaced: int
    recently_refused: dict[str, int]  # frames, by reason
    recently_missing: int  # sent and not received, by the gaps between the stamps
    refused_since_answer: int  # frames in a row
    busy: float | None  # s for which the worker has had the same frame
    latency: Percentiles | None  # from receiving to publishing
    delay: Percentiles | None  # from the header's stamp to publishing, where that makes sense
    last: Kept | None  # of the last frame that was answered; None: there was none


class Statistics(Generic[Result, Kept]):
    """Counts frames; all methods may be called from any thread.

    Args:
        refusals: logs and counts what is refused.
        tell: stamp of the frame (ns) and what is told of a result.
        ros_time: now in ns, by the clock of the stamps.
        clock: s, monotonic.
    """

    def __init__(
        self,
        refusals: Refusals,
        tell: Callable[[Result], tuple[int, Kept]],
        ros_time: Callable[[], int] = time.time_ns,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._refusals = refusals
        self._tell = tell
        self._ros_time = ros_time
        self._clock = clock
        self._lock = threading.Lock()
        self._received: Counter[str] = Counter()
        self._answered = self._replaced = self._refused = self._dropped = self._in_a_row = 0
        self._last: Kept | None = None
        self._started: float | None = None
        # Times of what happened, and what is told of each answer.
        self._in: deque[float] = deque(maxlen=_MOST_FRAMES)
        self._stamps: dict[str, deque[tuple[float, int]]] = {}
        self._refused_at: deque[tuple[float, str]] = deque(maxlen=_MOST_FRAMES)
        self._replaced_at: deque[float] = deque(maxlen=_MOST_FRAMES)
        self._out: deque[tuple[float, float, float]] = deque(maxlen=_MOST_FRAMES)

    def received(self, topic: str, message: Any) -> None:
        """A frame has come: a message with a header."""
        with self._lock:
            now = self._clock()
            self._received[topic] += 1
            self._in.append(now)
            stamps = self._stamps.setdefault(topic, deque(maxlen=_MOST_FRAMES))
            stamps.append((now, stamp_ns(message)))

    def replaced(self) -> None:
        """A frame gave way to a newer one before it was looked at."""
        with self._lock:
            self._replaced += 1
            self._replaced_at.append(self._clock())

    def dropped(self, count: int) -> None:
        """The node was deactivated before these frames were answered."""
        with self._lock:
            self._dropped += count

    def started(self) -> None:
        """The worker has taken a frame."""
        self._started = self._clock()

    def ended(self) -> None:
        self._started = None

    def refused(self, refusal: Refusal) -> None:
        with self._lock:
            self._refused += 1
            self._in_a_row += 1
            self._refused_at.append((self._clock(), refusal.reason))
        self._refusals.add(refusal.reason, refusal.detail)

    def answered(self, result: Result, received: float) -> None:
        """A result was published of a frame that had been received at this time of the clock."""
        input_stamp_ns, summary = self._tell(result)
        now = self._clock()
        delay = (self._ros_time() - input_stamp_ns) * 1e-9
        with self._lock:
            self._answered += 1
            self._in_a_row = 0
            self._out.append((now, now - received, delay))
            self._last = summary

    def summary(self) -> Summary[Kept]:
        """How things are now."""
        with self._lock:
            since = self._clock() - WINDOW
            out = [item for item in self._out if item[0] >= since]
            started = self._started
            return Summary(
                received=dict(self._received),
                answered=self._answered,
                replaced=self._replaced,
                dropped=self._dropped,
                refused=self._refused,
                refusals=dict(self._refusals.counts),
                rate_in=_rate([when for when in self._in if when >= since]),
                rate_out=_rate([when for when, _, _ in out]),
                recently_received=sum(when >= since for when in self._in),
                recently_replaced=sum(when >= since for when in self._replaced_at),
                recently_refused=Counter(r for when, r in self._refused_at if when >= since),
                recently_missing=sum(
                    missing([stamp for when, stamp in stamps if when >= since])
                    for stamps in self._stamps.values()
                ),
                refused_since_answer=self._in_a_row,
                busy=None if started is None else self._clock() - started,
                latency=_percentiles([latency for _, latency, _ in out]),
                delay=_percentiles([d for _, _, d in out if 0.0 <= d <= _OLDEST_STAMP]),
                last=self._last,
            )


def _rate(times: list[float]) -> float:
    """Hz; of a single moment nothing can be said."""
    span = times[-1] - times[0] if times else 0.0
    return (len(times) - 1) / span if span > 0.0 else 0.0


def _percentiles(values: list[float]) -> Percentiles | None:
    if not values:
        return None
    median, high = np.percentile(values, (50, 95)).tolist()
    return median, high
