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
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.ros.node.refusals import describe
from rs_localizer.ros.node.statistics import Event, Statistics

Result = TypeVar("Result")
Work = Callable[[str, Any], Result | Refusal | Iterator[Result | Refusal] | None]
"""What is done with a topic's message. It may have no result, or several, which are published as
they come.
"""

_NAME = "rs_localizer worker"
# Interval (s) at which waiting frames are looked at, and how many may wait.
_LOOK_PERIOD = 0.002
_MOST_WAITING = 100


@dataclass(frozen=True, slots=True)
class _Arrival:
    """A frame that has come."""

    topic: str
    message: Any
    received: float  # s, time.monotonic()
    session: int  # its result is wanted as long as this is the worker's


class Worker(Generic[Result]):
    """A thread that alone does the work and applies updates of what that depends on.

    What waits for it is bounded: one frame of each topic and one update of each kind. All methods
    may be called from any thread; none of them waits for the work.

    Args:
        work: makes results of frames.
        publish: called in the thread with each result, never after :meth:`pause`.
        statistics: told what becomes of each frame.
        failed: told in one sentence of errors in updates that nobody foresaw; the thread goes on.
            Those in frames are refusals, ``internal_error``.
        patience: time (s) that a frame waits, since its arrival, for what it lacks; 0: it does not
            wait.
    """

    def __init__(
        self,
        work: Work[Result],
        publish: Callable[[Result], None],
        statistics: Statistics[Result],
        failed: Callable[[str], None],
        patience: Callable[[Any], float] = lambda _: 0.0,
    ) -> None:
        self._work, self._publish, self._patience = work, publish, patience
        self._statistics, self._failed = statistics, failed
        self._changed = threading.Condition()  # of the next four
        self._updates: dict[str, Callable[[], None]] = {}
        self._frames: dict[str, _Arrival] = {}
        self._session = 0
        self._closed = False
        self._waiting: deque[_Arrival] = deque()  # the thread's: frames that lack something
        # Held while publishing: after pause() nothing comes any more.
        self._publishing = threading.Lock()
        threading.Thread(target=self._run, name=_NAME, daemon=True).start()

    def update(self, kind: str, update: Callable[[], None]) -> None:
        """Queue this before the next frame, after all updates of other kinds so far.

        An older update of the same kind that still waits is dropped: an update describes the
        present state, not a change.
        """
        with self._changed:
            self._updates.pop(kind, None)
            self._updates[kind] = update
            self._changed.notify()

    def process(self, topic: str, message: Any) -> None:
        """Queue a frame to be processed, unless a newer one of its topic comes first.

        That takes its place. While a frame lacks something it waits, and those behind it, too.
        """
        self._statistics.received(topic, message)
        with self._changed:
            replaced = topic in self._frames
            self._frames[topic] = _Arrival(topic, message, time.monotonic(), self._session)
            self._changed.notify()
        if replaced:
            self._statistics.count(Event.REPLACED)

    def pause(self) -> None:
        """Forget the frames so far, the one that is worked on included."""
        with self._publishing, self._changed:
            self._statistics.count(Event.DROPPED, count=len(self._frames))
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
        while self._take():
            if self._is_ready():
                self._begin(self._waiting.popleft())

    def _take(self) -> bool:
        """Wait for something to do, apply updates and take a frame; False at the end."""
        timeout = 0.0 if self._is_ready() else _LOOK_PERIOD if self._waiting else None
        with self._changed:
            self._changed.wait_for(lambda: self._updates or self._frames or self._closed, timeout)
            updates, self._updates = self._updates, {}
            if oldest := next(iter(self._frames), None):
                self._waiting.append(self._frames.pop(oldest))
        for update in updates.values():
            if isinstance(failure := self._attempt(update), Refusal):
                self._failed(failure.detail)
        return not self._closed

    def _is_ready(self) -> bool:
        """Return True if there is a frame that need not wait."""
        if not self._waiting or len(self._waiting) > _MOST_WAITING:
            return bool(self._waiting)
        frame = self._waiting[0]
        patience = self._attempt(lambda: self._patience(frame.message)) or 0.0
        return time.monotonic() >= frame.received + patience

    def _is_wanted(self, frame: _Arrival) -> bool:
        with self._changed:
            return frame.session == self._session and not self._closed

    def _begin(self, frame: _Arrival) -> None:
        if not self._is_wanted(frame):
            self._statistics.count(Event.DROPPED)
            return
        self._statistics.started()
        result = self._attempt(lambda: self._work(frame.topic, frame.message))
        several = result if isinstance(result, Iterator) else iter([result])
        while (each := self._attempt(lambda: next(several, None))) is not None:
            self._finish(frame, each)
        self._statistics.ended()

    def _attempt(self, function: Callable[[], Any]) -> Any:
        """Return the function's value, or a refusal if it fails."""
        try:
            return function()
        except Exception as error:  # of one message: the others go on
            return Refusal(Reason.INTERNAL_ERROR, describe(error))

    def _finish(self, frame: _Arrival, result: Result | Refusal) -> None:
        """Publish it, unless nobody wants it any more, and count it."""
        if isinstance(result, Refusal):
            self._statistics.refused(result)
            return
        with self._publishing:
            wanted = self._is_wanted(frame)
            if wanted:
                failure = self._attempt(lambda: self._publish(result))
        if not wanted:
            self._statistics.count(Event.DROPPED)
        elif failure is not None:
            self._statistics.refused(failure)
        else:
            self._statistics.answered(result, frame.received)


def wait_for_workers(seconds: float) -> bool:
    """Wait for the end of the threads of all workers; whether it came in time."""
    deadline = time.monotonic() + seconds
    threads = [thread for thread in threading.enumerate() if thread.name == _NAME]
    for thread in threads:
        thread.join(max(0.0, deadline - time.monotonic()))
    return not any(thread.is_alive() for thread in threads)
