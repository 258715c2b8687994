# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C, SIGTERM and SIGHUP as an orderly end.

Imports nothing that takes time, so that a program can begin with it.
"""

import contextlib
import faulthandler
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import ClassVar, Self

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Base of the exit code that shells report of a program that a signal ended: 130 for Ctrl-C, 143 for
# SIGTERM.
_SIGNALLED = 128
INTERRUPTED = _SIGNALLED + signal.SIGINT
"""Exit code after Ctrl-C."""

# An import that breaks off leaves half a module.
_FRAGILE = ("importlib", "_frozen_importlib")
# A child that has been started but not been returned is nobody's: nobody would end it.
_STARTS = "Popen.__init__"
# s: how often it is tried to interrupt them; so long an import may take, of which nothing stays.
_PERIOD, _PATIENCE = 0.02, 2.0
# s until an exception that nobody handles counts as lost, as in a finalizer; unwinding takes less.
_LOST = 0.5


class StopRequest:
    """Within ``with``, signals set :attr:`requested` and raise nothing.

    An exception in the middle of a callback, or of rclpy's own clean-up, is lost or breaks it.
    Leaving ignores signals for good, since the process is about to end: a launch file and a
    terminal send theirs at the same time.
    """

    code: ClassVar[int] = 0
    """What shells report of a program that was ended by the signal that came, to whichever of
    several that are entered within each other; 0: none has come."""

    clean_up: ClassVar[list[Callable[[], None]]] = []
    """Called before the process ends in the middle of its work."""

    def __init__(self) -> None:
        self.requested = False
        self._at_once: tuple[int | None, str] | None = None

    def __enter__(self) -> Self:
        for number in _SIGNALS:
            if signal.getsignal(number) != signal.SIG_IGN or number != signal.SIGHUP:  # nohup
                signal.signal(number, self._take)
        return self

    def __exit__(self, *_: object) -> None:
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    @contextlib.contextmanager
    def at_once(self, code: int | None = 0, text: str = "") -> Iterator[None]:
        """End the process at once on a signal, within the context: for imports.

        An import takes long, and an exception inside it may be lost or come out as another one. No
        results exist meanwhile.

        Args:
            code: exit code; None: :attr:`code`.
            text: written to stderr.
        """
        before, self._at_once = self._at_once, (code, text)
        try:
            if self.requested:
                self._leave(code, text)
            yield
        finally:
            self._at_once = before

    def _take(self, number: int, frame: FrameType | None) -> None:
        StopRequest.code = _SIGNALLED + number
        if self._at_once is not None:
            self._leave(*self._at_once)
        first, self.requested = not self.requested, True
        if first:
            self._stop(frame)

    def _leave(self, code: int | None, text: str) -> None:
        for function in self.clean_up:
            function()
        os.write(2, text.encode())
        os._exit(self.code if code is None else code)

    def _stop(self, frame: FrameType | None) -> None:
        """Take the first signal."""


class StopSignals(StopRequest):
    """The first signal raises KeyboardInterrupt in the main thread; more change nothing.

    It waits until none of :data:`_FRAGILE` is on the stack, and no process is being started, at
    most :data:`_PATIENCE`: then the process ends. Where the exception gets lost, it is raised
    again.
    Enter it before ``rclpy.init``: rclpy's own handlers call those that they found.
    """

    last_words = "interrupted\n"
    """Written to stderr where the process ends in the middle of its work."""

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        signal.setitimer(signal.ITIMER_REAL, 0.0)

    def _stop(self, frame: FrameType | None) -> None:
        self._deadline = time.monotonic() + _PATIENCE
        signal.signal(signal.SIGALRM, lambda _, frame: self._interrupt(frame))
        sys.unraisablehook = self._repeat
        self._due = True
        self._interrupt(frame)

    def _repeat(self, lost: "sys.UnraisableHookArgs") -> None:
        """Repeat an interrupt that a finalizer has lost."""
        if lost.exc_type is KeyboardInterrupt:
            self._due = True
            signal.setitimer(signal.ITIMER_REAL, _PERIOD)
        else:
            sys.__unraisablehook__(lost)

    def _interrupt(self, frame: FrameType | None) -> None:
        """Raise where nobody handles an exception, twice in a row: an end takes less."""
        handled = _is_handled(sys.exception())
        fragile = not handled and _is_fragile(frame)
        raised = self._due and not handled and not fragile
        self._due = not handled and not raised
        signal.setitimer(signal.ITIMER_REAL, _PERIOD if self._due else _LOST)
        if raised:
            raise KeyboardInterrupt
        if fragile and time.monotonic() > self._deadline:
            self._leave(None, self.last_words)


def _is_fragile(frame: FrameType | None) -> bool:
    while frame is not None:
        name = str(frame.f_globals.get("__name__"))
        if name.partition(".")[0] in _FRAGILE:
            return True
        if name == "subprocess" and frame.f_code.co_qualname == _STARTS:
            return True
        frame = frame.f_back
    return False


def _is_handled(error: BaseException | None) -> bool:
    """Return True if some code cleans up after a KeyboardInterrupt."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


@contextlib.contextmanager
def ends_within(seconds: float, code: int) -> Iterator[None]:
    """End the process with this exit code if what is done within takes longer (s), and say so."""

    def leave() -> None:
        sys.stderr.write(f"the process did not end within {seconds:g} s, and stands here:\n")
        faulthandler.dump_traceback(all_threads=True)
        os._exit(code)

    timer = threading.Timer(seconds, leave)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
