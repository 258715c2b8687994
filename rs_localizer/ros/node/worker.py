# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Works beside the executor, so that a slow frame delays nothing but frames.

The kernels release the GIL: meanwhile the executor takes messages, answers services, changes
parameters and publishes diagnostics.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from rs_localizer.core.reasons import Reason
from rs_localizer.pipeline.refusal import Refusal, Waiting
from rs_localizer.ros.node.refusals import describe
from rs_localizer.ros.node.statistics import Statistics

State = TypeVar("State")
Item = TypeVar("Item")
Update = Callable[[State], None]


@dataclass(frozen=True, slots=True)
class Work(Generic[State, Item]):
    """What is to be done next: the updates, then the frame."""

    updates: Iterable[Update[State]]
    frame: Item | None
    session: int  # see :meth:`Mailbox.is_current`


class Mailbox(Generic[State, Item]):
    """Bounded: it holds one frame of each topic and one update of each kind.

    All methods may be called from any thread; only :meth:`take` waits.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._updates: dict[str, Update[State]] = {}
        self._frames: dict[str, Item] = {}
        self._session = 0
        self._closed = self._woken = False

    def update(self, kind: str, update: Update[State]) -> None:
        """Have this done before the next frame, after all updates of other kinds so far.

        An older one of the same kind that still waits is dropped: an update says how things are
        now, not what has changed.
        """
        with self._changed:
            self._updates.pop(kind, None)
            self._updates[kind] = update
            self._changed.notify()

    def put(self, topic: str, frame: Item) -> bool:
        """Add a frame; whether it replaced one of its topic, whose place it then takes."""
        with self._changed:
            replaced = topic in self._frames
            self._frames[topic] = frame
            self._changed.notify()
            return replaced

    def take(self, timeout: float | None = None) -> Work[State, Item] | None:
        """Wait for all updates, and the oldest frame if there is any; None once it is closed.

        After ``timeout`` (s), or when it is woken, it may be nothing that is to be done.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: self._updates or self._frames or self._closed or self._woken, timeout
            )
            self._woken = False
            if self._closed:
                return None
            updates, self._updates = self._updates, {}
            oldest = next(iter(self._frames), None)
            frame = None if oldest is None else self._frames.pop(oldest)
            return Work(updates.values(), frame, self._session)

    def wake(self) -> None:
        """Let :meth:`take` return, whatever there is."""
        with self._changed:
            self._woken = True
            self._changed.notify()

    def drop_frames(self) -> int:
        """Forget the frames that wait (how many?), and end the session of the current one."""
        with self._changed:
            dropped = len(self._frames)
            self._frames.clear()
            self._session += 1
            return dropped

    def is_current(self, work: Work[State, Item]) -> bool:
        """Whether its result is still wanted."""
        with self._changed:
            return work.session == self._session and not self._closed

    def close(self) -> None:
        """Drop everything; :meth:`take` returns None from now on."""
        with self._changed:
            self._closed = True
            self._updates, self._frames = {}, {}
            self._changed.notify_all()


Result = TypeVar("Result")
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
    """What a frame waits for before it is processed."""

    missing: Callable[[State, Any], bool]  # whether something is, and may still come
    patience: float  # s for which it waits


@dataclass(frozen=True, slots=True)
class Arrival(Generic[State, Result]):
    """A frame that has come."""

    message: Any
    process: Process[State, Result]
    received: float  # s, time.monotonic()
    need: Need[State] | None


@dataclass(frozen=True, slots=True)
class _Late(Generic[State, Result]):
    """A frame whose result waits for something."""

    work: Work[State, Arrival[State, Result]]
    arrival: Arrival[State, Result]
    result: Waiting
    deadline: float  # s, time.monotonic()


class Worker(Generic[State, Result]):
    """A thread, and what it alone touches.

    Args:
        state: that; from now on only through updates and arrivals.
        publish: called in the thread with each result, never after :meth:`pause`.
        statistics: told what becomes of each frame.
        failed: told in one sentence of errors in updates that nobody foresaw; the thread goes on.
            Those in frames are refusals, ``internal_error``.
    """

    def __init__(
        self,
        state: State,
        publish: Callable[[Result], None],
        statistics: Statistics[Result, Any],
        failed: Callable[[str], None],
    ) -> None:
        self._state = state
        self._publish = publish
        self._statistics = statistics
        self._failed = failed
        self._mailbox: Mailbox[State, Arrival[State, Result]] = Mailbox()
        # Frames that wait for what they need, and results.
        self._early: deque[Work[State, Arrival[State, Result]]] = deque()
        self._late: deque[_Late[State, Result]] = deque()
        # Held while publishing: after pause() nothing comes any more.
        self._publishing = threading.Lock()
        in_thread(self._run)

    def update(self, kind: str, update: Update[State]) -> None:
        """Have this done before the next frame (see :meth:`Mailbox.update`)."""
        self._mailbox.update(kind, update)

    def process(
        self,
        topic: str,
        message: Any,
        process: Process[State, Result],
        need: Need[State] | None = None,
    ) -> None:
        """Have this frame processed and published, unless a newer one comes first.

        While it needs something it waits, and those behind it, too.
        """
        self._statistics.received(topic, message)
        arrival = Arrival(message, process, time.monotonic(), need)
        if self._mailbox.put(topic, arrival):
            self._statistics.replaced()

    def look(self) -> None:
        """Something has come that a frame may have waited for."""
        if self._early:
            self._mailbox.wake()

    def pause(self) -> None:
        """Forget the frames so far, the one that is worked on included."""
        with self._publishing:
            self._statistics.dropped(self._mailbox.drop_frames())

    def close(self) -> None:
        """End the thread after the frame that it works on, of which nothing is published."""
        with self._publishing:
            self._mailbox.close()

    # -- in the thread ----------------------------------------------------------------------

    def _run(self) -> None:
        while (work := self._mailbox.take(self._timeout())) is not None:
            for update in work.updates:
                self._guarded(update, self._state)
            self._finish_late()
            if work.frame is not None:
                self._early.append(work)
            if self._is_ready():
                self._begin(self._early.popleft())

    def _timeout(self) -> float | None:
        """How long nothing has to be done, unless something comes."""
        if self._is_ready():
            return 0.0
        return _LATE_PERIOD if self._late or self._early else None

    def _is_ready(self) -> bool:
        """Whether there is a frame that need not wait."""
        arrival = self._early[0].frame if self._early else None
        if arrival is None or (need := arrival.need) is None:
            return arrival is not None
        overdue = time.monotonic() >= arrival.received + need.patience
        if overdue or len(self._early) > _MOST_LATE:
            return True
        return self._attempt(lambda: need.missing(self._state, arrival.message)) is not True

    def _begin(self, work: Work[State, Arrival[State, Result]]) -> None:
        assert work.frame is not None
        if self._mailbox.is_current(work):
            self._process(work, work.frame)
        else:
            self._statistics.dropped(1)

    def _guarded(self, function: Callable[..., None], *arguments: Any) -> None:
        try:
            function(*arguments)
        except Exception as error:  # of one message: the others go on
            self._failed(describe(error))

    def _process(
        self, work: Work[State, Arrival[State, Result]], arrival: Arrival[State, Result]
    ) -> None:
        self._statistics.started()
        for each in self._results(arrival):
            if isinstance(each, Waiting) and len(self._late) < _MOST_LATE:
                deadline = time.monotonic() + each.patience
                self._late.append(_Late(work, arrival, each, deadline))
            else:
                self._finish(work, arrival, each)
        self._statistics.ended()

    def _results(self, arrival: Arrival[State, Result]) -> Iterator[Any]:
        """What comes of a frame."""
        result = self._attempt(lambda: arrival.process(self._state, arrival.message))
        several = result if isinstance(result, Iterator) else iter([result])
        while (each := self._attempt(lambda: next(several, None))) is not None:
            yield each

    def _finish_late(self) -> None:
        """Publish what has become known, in the order in which it came; give up what is overdue."""
        while self._late:
            item = self._late[0]
            result = self._attempt(item.result.again)
            patient = time.monotonic() < item.deadline and self._mailbox.is_current(item.work)
            if isinstance(result, Waiting) and patient:
                return
            self._late.popleft()
            self._finish(item.work, item.arrival, result)

    def _attempt(self, function: Callable[[], Any]) -> Any:
        """What it returns; if it fails, a refusal."""
        try:
            return function()
        except Exception as error:  # of one message: the others go on
            return Refusal(Reason.INTERNAL_ERROR, describe(error))

    def _finish(
        self,
        work: Work[State, Arrival[State, Result]],
        arrival: Arrival[State, Result],
        result: Result | Refusal,
    ) -> None:
        """Publish it, unless nobody wants it any more, and count it."""
        if isinstance(result, Refusal):
            self._statistics.refused(result)
            return
        with self._publishing:
            wanted = self._mailbox.is_current(work)
            if wanted:
                failure = self._attempt(lambda: self._publish(result))
        if not wanted:
            self._statistics.dropped(1)
        elif failure is not None:
            self._statistics.refused(failure)
        else:
            self._statistics.answered(result, arrival.received)


def in_thread(function: Callable[[], None]) -> None:
    """Run what may take minutes, which must not keep the process alive."""
    threading.Thread(target=function, name=_NAME, daemon=True).start()


def wait_for_workers(seconds: float) -> bool:
    """Wait for the end of all threads of :func:`in_thread`; whether it came in time."""
    deadline = time.monotonic() + seconds
    threads = [thread for thread in threading.enumerate() if thread.name == _NAME]
    for thread in threads:
        thread.join(max(0.0, deadline - time.monotonic()))
    return not any(thread.is_alive() for thread in threads)
