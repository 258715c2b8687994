# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Works beside the executor, so that a slow frame delays nothing but frames.

The kernels release the GIL: meanwhile the executor takes messages, answers services, changes
parameters and publishes diagnostics.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from rs_localizer.core.reasons import Reason
from rs_localizer.pipeline.refusal import Refusal, Waiting
from rs_localizer.ros.node.refusals import describe
from rs_localizer.ros.node.statistics import Statistics

State = TypeVar("State")
Result = TypeVar("Result")
Update = Callable[[State], None]
Process = Callable[[State, Any], Result | Refusal | Iterator[Result | Refusal] | None]
"""What is done with a message, given what the worker alone touches; a message may have no result,
or several, which are published as they come.
"""

_NAME = "rs_localizer worker"
# How often frames and results are looked at that wait for something, in s, and how many may.
_LATE_PERIOD = 0.005
_MOST_LATE = 100


@dataclass(frozen=True, slots=True)
class Need(Generic[State]):
    """Condition that a frame waits for before it is processed."""

    missing: Callable[[State, Any], bool]  # whether something is, and may still come
    patience: float  # s for which it waits


@dataclass(frozen=True, slots=True)
class _Arrival(Generic[State, Result]):
    """A frame that has come."""

    message: Any
    process: Process[State, Result]
    received: float  # s, time.monotonic()
    need: Need[State] | None
    session: int  # its result is wanted as long as this is the worker's


@dataclass(frozen=True, slots=True)
class _Late(Generic[State, Result]):
    """A frame whose result waits for something."""

    arrival: _Arrival[State, Result]
    result: Waiting
    deadline: float  # s, time.monotonic()


class Worker(Generic[State, Result]):
    """A thread, and what it alone touches.

    What waits for it is bounded: one frame of each topic and one update of each kind. All methods
    may be called from any thread; none of them waits for the work.

    Args:
        state: that; from now on only through updates and frames.
        publish: called in the thread with each result, never after :meth:`pause`.
        statistics: told what becomes of each frame.
        failed: told in one sentence of errors in updates that nobody foresaw; the thread goes on.
            Those in frames are refusals, ``internal_error``.
    """

    def __init__(
        self,
        state: State,
        publish: Callable[[Result], None],
        statistics: Statistics[Result],
        failed: Callable[[str], None],
    ) -> None:
        self._state = state
        self._publish = publish
        self._statistics = statistics
        self._failed = failed
        self._changed = threading.Condition()  # of the next five
        self._updates: dict[str, Update[State]] = {}
        self._frames: dict[str, _Arrival[State, Result]] = {}
        self._session = 0
        self._closed = self._woken = False
        # The thread's: frames that wait for what they need, and results.
        self._early: deque[_Arrival[State, Result]] = deque()
        self._late: deque[_Late[State, Result]] = deque()
        # Held while publishing: after pause() nothing comes any more.
        self._publishing = threading.Lock()
        threading.Thread(target=self._run, name=_NAME, daemon=True).start()

    def update(self, kind: str, update: Update[State]) -> None:
        """Have this done before the next frame, after all updates of other kinds so far.

        An older one of the same kind that still waits is dropped: an update says how things are
        now, not what has changed.
        """
        with self._changed:
            self._updates.pop(kind, None)
            self._updates[kind] = update
            self._changed.notify()

    def process(
        self,
        topic: str,
        message: Any,
        process: Process[State, Result],
        need: Need[State] | None = None,
    ) -> None:
        """Have this frame processed and published, unless a newer one comes first.

        That takes its place. While a frame needs something it waits, and those behind it, too.
        """
        self._statistics.received(topic, message)
        with self._changed:
            replaced = topic in self._frames
            arrival = _Arrival(message, process, time.monotonic(), need, self._session)
            self._frames[topic] = arrival
            self._changed.notify()
        if replaced:
            self._statistics.replaced()

    def look(self) -> None:
        """Something has come that a frame may have waited for."""
        if self._early:
            with self._changed:
                self._woken = True
                self._changed.notify()

    def pause(self) -> None:
        """Forget the frames so far, the one that is worked on included."""
        with self._publishing, self._changed:
            self._statistics.dropped(len(self._frames))
            self._frames.clear()
            self._session += 1

    def close(self) -> None:
        """End the thread after the frame that it works on, of which nothing is published."""
        with self._publishing, self._changed:
            self._closed = True
            self._updates, self._frames = {}, {}
            self._changed.notify()

    # -- in the thread ----------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            timeout = 0.0 if self._is_ready() else None
            if timeout is None and (self._late or self._early):
                timeout = _LATE_PERIOD
            with self._changed:
                self._changed.wait_for(
                    lambda: self._updates or self._frames or self._closed or self._woken, timeout
                )
                if self._closed:
                    return
                self._woken = False
                updates, self._updates = self._updates, {}
                oldest = next(iter(self._frames), None)
                frame = None if oldest is None else self._frames.pop(oldest)
            for update in updates.values():
                try:
                    update(self._state)
                except Exception as error:  # of one message: the others go on
                    self._failed(describe(error))
            self._finish_late()
            if frame is not None:
                self._early.append(frame)
            if self._is_ready():
                self._begin(self._early.popleft())

    def _is_ready(self) -> bool:
        """True if there is a frame that need not wait."""
        if not self._early:
            return False
        arrival = self._early[0]
        if (need := arrival.need) is None:
            return True
        overdue = time.monotonic() >= arrival.received + need.patience
        if overdue or len(self._early) > _MOST_LATE:
            return True
        return self._attempt(lambda: need.missing(self._state, arrival.message)) is not True

    def _is_wanted(self, arrival: _Arrival[State, Result]) -> bool:
        with self._changed:
            return arrival.session == self._session and not self._closed

    def _begin(self, arrival: _Arrival[State, Result]) -> None:
        if not self._is_wanted(arrival):
            self._statistics.dropped(1)
            return
        self._statistics.started()
        for each in self._results(arrival):
            if isinstance(each, Waiting) and len(self._late) < _MOST_LATE:
                deadline = time.monotonic() + each.patience
                self._late.append(_Late(arrival, each, deadline))
            else:
                self._finish(arrival, each)
        self._statistics.ended()

    def _results(self, arrival: _Arrival[State, Result]) -> Iterator[Any]:
        """Results of a frame."""
        result = self._attempt(lambda: arrival.process(self._state, arrival.message))
        several = result if isinstance(result, Iterator) else iter([result])
        while (each := self._attempt(lambda: next(several, None))) is not None:
            yield each

    def _finish_late(self) -> None:
        """Publish what has become known, in the order in which it came; give up what is overdue."""
        while self._late:
            item = self._late[0]
            result = self._attempt(item.result.again)
            patient = time.monotonic() < item.deadline and self._is_wanted(item.arrival)
            if isinstance(result, Waiting) and patient:
                return
            self._late.popleft()
            self._finish(item.arrival, result)

    def _attempt(self, function: Callable[[], Any]) -> Any:
        """The function's value, or a refusal where it fails."""
        try:
            return function()
        except Exception as error:  # of one message: the others go on
            return Refusal(Reason.INTERNAL_ERROR, describe(error))

    def _finish(self, arrival: _Arrival[State, Result], result: Result | Refusal) -> None:
        """Publish it, unless nobody wants it any more, and count it."""
        if isinstance(result, Refusal):
            self._statistics.refused(result)
            return
        with self._publishing:
            wanted = self._is_wanted(arrival)
            if wanted:
                failure = self._attempt(lambda: self._publish(result))
        if not wanted:
            self._statistics.dropped(1)
        elif failure is not None:
            self._statistics.refused(failure)
        else:
            self._statistics.answered(result, arrival.received)


def wait_for_workers(seconds: float) -> bool:
    """Wait for the end of the threads of all workers; whether it came in time."""
    deadline = time.monotonic() + seconds
    threads = [thread for thread in threading.enumerate() if thread.name == _NAME]
    for thread in threads:
        thread.join(max(0.0, deadline - time.monotonic()))
    return not any(thread.is_alive() for thread in threads)
