# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C, SIGTERM and SIGHUP as an orderly end.

Imports nothing that takes time, so that a program can begin with it.
"""

import contextlib
import faulthandler
import math
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

# s between signals that are one wish.
_TOGETHER = 1.0


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

    def _take(self, number: int, _: FrameType | None) -> None:
        StopRequest.code = _SIGNALLED + number
        if self._at_once is not None:
            self._leave(*self._at_once)
        self.requested = True
        self._stop()

    def _leave(self, code: int | None, text: str) -> None:
        for function in self.clean_up:
            function()
        os.write(2, text.encode())
        os._exit(self.code if code is None else code)

    def _stop(self) -> None:
        """Take a signal."""


class StopSignals(StopRequest):
    """A signal raises KeyboardInterrupt in the main thread.

    Others that follow at once change nothing: a launch file and a terminal send theirs at the same
    time.
    """

    _last = -math.inf

    def _stop(self) -> None:
        now = time.monotonic()
        before, self._last = self._last, now
        if now - before > _TOGETHER:
            raise KeyboardInterrupt


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
