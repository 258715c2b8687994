# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Statistics of frames: totals since the start, and of the last seconds."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Generic, TypeVar

import numpy as np

from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.ros.node.refusals import Refusals

Result = TypeVar("Result")

WINDOW = 5.0
"""What "now" means, in s."""

# Events that are remembered; a window of faster cameras is shorter.
_MOST_EVENTS = 8192

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
    refused_since_answer: int  # frames in a row
    busy: float | None  # s for which the worker has had the same frame
    latency: Percentiles | None  # from receiving to publishing
    last: Told | None  # of the last frame that was answered; None: there was none


class Statistics(Generic[Result]):
    """Counts frames; all methods may be called from any thread.

    Args:
        refusals: logs and counts what is refused.
        tell: what is told of a result.
        clock: s, monotonic.
    """

    def __init__(
        self,
        refusals: Refusals,
        tell: Callable[[Result], Told],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._refusals, self._tell = refusals, tell
        self._clock = clock
        self._lock = threading.Lock()
        self._total: Counter[Event] = Counter()
        self._in_a_row = 0
        self._last: Told | None = None
        self._started: float | None = None
        # When what happened, with a reason, or the latency in s.
        self._events: deque[tuple[float, Event, Any]] = deque(maxlen=_MOST_EVENTS)

    def _add(self, event: Event, what: Any = None, count: int = 1) -> None:
        self._total[event] += count
        self._events.append((self._clock(), event, what))

    def received(self) -> None:
        with self._lock:
            self._add(Event.RECEIVED)

    def replaced(self) -> None:
        with self._lock:
            self._add(Event.REPLACED)

    def dropped(self, count: int) -> None:
        with self._lock:
            self._add(Event.DROPPED, count=count)

    def started(self) -> None:
        """The worker has taken a frame."""
        self._started = self._clock()

    def ended(self) -> None:
        self._started = None

    def refused(self, refusal: Refusal) -> None:
        with self._lock:
            self._add(Event.REFUSED, refusal.reason)
            self._in_a_row += 1
        self._refusals.add(refusal.reason, refusal.detail)

    def answered(self, result: Result, received: float) -> None:
        """A result was published of a frame that had been received at this time of the clock."""
        kept = self._tell(result)
        with self._lock:
            self._add(Event.ANSWERED, self._clock() - received)
            self._in_a_row = 0
            self._last = kept

    def summary(self) -> Summary:
        """The state of the frames now."""
        with self._lock:
            now, started = self._clock(), self._started
            recent = [item for item in self._events if item[0] >= now - WINDOW]
            total, last, in_a_row = Counter(self._total), self._last, self._in_a_row

        def of(event: Event) -> list[tuple[float, Any]]:
            return [(when, what) for when, each, what in recent if each is event]

        came, out = of(Event.RECEIVED), of(Event.ANSWERED)
        return Summary(
            total=total,
            lately=Counter(event for _, event, _ in recent),
            reasons=dict(self._refusals.counts),
            recent_reasons=Counter(reason for _, reason in of(Event.REFUSED)),
            rate_in=_rate([when for when, _ in came]),
            rate_out=_rate([when for when, _ in out]),
            refused_since_answer=in_a_row,
            busy=None if started is None else now - started,
            latency=_percentiles([latency for _, latency in out]),
            last=last,
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
