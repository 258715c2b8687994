"""Localizes beside the executor, so that a slow frame delays nothing but frames.

The kernels release the GIL: meanwhile the executor takes messages, answers services, changes
parameters and publishes diagnostics.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rs_localizer.io.outputs import Frame
from rs_localizer.pipeline.frames import FrameLocalizer, Refusal, Waiting
from rs_localizer.ros.node.errors import describe
from rs_localizer.ros.node.mailbox import Mailbox, Update, Work
from rs_localizer.ros.node.statistics import Statistics

Localize = Callable[[FrameLocalizer, Any], Frame | Refusal]
_NAME = "rs_localizer worker"
Awaits = Callable[[FrameLocalizer, Any], bool]
# How often frames are looked at that wait for something, in s, and how many may.
_LATE_PERIOD = 0.005
_MOST_LATE = 100


@dataclass(frozen=True, slots=True)
class Arrival:
    """A frame that has come."""

    topic: str
    message: Any
    localize: Localize
    received: float  # s, time.monotonic()
    awaits: Awaits | None  # whether something that it needs may still come
    patience: float  # s for which it waits


@dataclass(frozen=True, slots=True)
class _Late:
    """A frame that is localized and waits for its mounting."""

    work: Work[FrameLocalizer, Arrival]
    arrival: Arrival
    result: Waiting
    deadline: float  # s, time.monotonic()


class Worker:
    """A thread, and what it alone touches: the localizer of the frames.

    Args:
        frames: localizes; from now on only through updates and arrivals.
        publish: called in the thread with each localized frame, never after :meth:`pause`.
        statistics: told what becomes of each frame.
        failed: told in one sentence of errors in updates that nobody foresaw; the thread goes on.
            Those in frames are refusals, ``internal_error``.
    """

    def __init__(
        self,
        frames: FrameLocalizer,
        publish: Callable[[Frame], None],
        statistics: Statistics,
        failed: Callable[[str], None],
    ) -> None:
        self._frames = frames
        self._publish = publish
        self._statistics = statistics
        self._failed = failed
        self._mailbox: Mailbox[FrameLocalizer, Arrival] = Mailbox()
        # Frames that wait for what they need, and localized ones for their mounting.
        self._early: deque[tuple[Work[FrameLocalizer, Arrival], Arrival]] = deque()
        self._late: deque[_Late] = deque()
        # Held while publishing: after pause() nothing comes any more.
        self._publishing = threading.Lock()
        in_thread(self._run)

    def update(self, kind: str, update: Update[FrameLocalizer]) -> None:
        """Have this done before the next frame (see :meth:`Mailbox.update`)."""
        self._mailbox.update(kind, update)

    def localize(
        self,
        topic: str,
        message: Any,
        localize: Localize,
        awaits: Awaits | None = None,
        patience: float = 0.0,
    ) -> None:
        """Have this frame localized and published, unless a newer one comes first.

        It, and those behind it, waits while it ``awaits`` something, but for ``patience`` (s) only.
        """
        self._statistics.received(topic, message)
        arrival = Arrival(topic, message, localize, time.monotonic(), awaits, patience)
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
                self._guarded(update, self._frames)
            self._finish_late()
            if work.frame is not None:
                self._early.append((work, work.frame))
            if self._early and not self._waits(self._early[0][1]):
                self._begin(*self._early.popleft())

    def _timeout(self) -> float | None:
        """How long nothing has to be done, unless something comes."""
        if self._early and not self._waits(self._early[0][1]):
            return 0.0
        return _LATE_PERIOD if self._late or self._early else None

    def _waits(self, arrival: Arrival) -> bool:
        overdue = time.monotonic() >= arrival.received + arrival.patience
        if overdue or arrival.awaits is None or len(self._early) > _MOST_LATE:
            return False
        return self._attempt(lambda: arrival.awaits(self._frames, arrival.message)) is True

    def _begin(self, work: Work[FrameLocalizer, Arrival], arrival: Arrival) -> None:
        if self._mailbox.is_current(work):
            self._localize(work, arrival)
        else:
            self._statistics.dropped(1)

    def _guarded(self, function: Callable[..., None], *arguments: Any) -> None:
        try:
            function(*arguments)
        except Exception as error:  # of one message: the others go on
            self._failed(describe(error))

    def _localize(self, work: Work[FrameLocalizer, Arrival], arrival: Arrival) -> None:
        self._statistics.started()
        result = self._attempt(lambda: arrival.localize(self._frames, arrival.message))
        self._statistics.ended()
        if isinstance(result, Waiting) and len(self._late) < _MOST_LATE:
            deadline = time.monotonic() + result.patience
            self._late.append(_Late(work, arrival, result, deadline))
        else:
            self._finish(work, arrival, result)

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
            return Refusal("internal_error", describe(error))

    def _finish(
        self, work: Work[FrameLocalizer, Arrival], arrival: Arrival, result: Frame | Refusal
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
