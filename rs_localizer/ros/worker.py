"""Localizes beside the executor, so that a slow frame delays nothing but frames.

The kernels release the GIL: meanwhile the executor takes messages, answers services, changes
parameters and publishes diagnostics.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rs_localizer.frames import FrameLocalizer, Refusal
from rs_localizer.io.outputs import Frame
from rs_localizer.ros.errors import describe
from rs_localizer.ros.mailbox import Mailbox, Update, Work
from rs_localizer.ros.statistics import Statistics

Localize = Callable[[FrameLocalizer, Any], Frame | Refusal]
_NAME = "rs_localizer worker"


@dataclass(frozen=True, slots=True)
class Arrival:
    """A frame that has come."""

    topic: str
    message: Any
    localize: Localize
    received: float  # s, time.monotonic()


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
        # Held while publishing: after pause() nothing comes any more.
        self._publishing = threading.Lock()
        in_thread(self._run)

    def update(self, kind: str, update: Update[FrameLocalizer]) -> None:
        """Have this done before the next frame (see :meth:`Mailbox.update`)."""
        self._mailbox.update(kind, update)

    def localize(self, topic: str, message: Any, localize: Localize) -> None:
        """Have this frame localized and published, unless a newer one comes first."""
        self._statistics.received(topic, message)
        arrival = Arrival(topic, message, localize, time.monotonic())
        if self._mailbox.put(topic, arrival):
            self._statistics.replaced()

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
        while (work := self._mailbox.take()) is not None:
            for update in work.updates:
                self._guarded(update, self._frames)
            if work.frame is not None:
                self._localize(work, work.frame)

    def _guarded(self, function: Callable[..., None], *arguments: Any) -> None:
        try:
            function(*arguments)
        except Exception as error:  # of one message: the others go on
            self._failed(describe(error))

    def _localize(self, work: Work[FrameLocalizer, Arrival], arrival: Arrival) -> None:
        try:
            result = self._answer(work, arrival)
        except Exception as error:  # of one message: the others go on
            result = Refusal("internal_error", describe(error))
        if isinstance(result, Refusal):
            self._statistics.refused(result)
        elif result is None:
            self._statistics.dropped(1)
        else:
            self._statistics.answered(result, arrival.received)

    def _answer(
        self, work: Work[FrameLocalizer, Arrival], arrival: Arrival
    ) -> Frame | Refusal | None:
        """What was published, or why nothing was; None: nobody wants it any more."""
        self._statistics.started()
        try:
            result = arrival.localize(self._frames, arrival.message)
        finally:
            self._statistics.ended()
        if not result:
            return result
        with self._publishing:
            if not self._mailbox.is_current(work):
                return None
            self._publish(result)
        return result


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
