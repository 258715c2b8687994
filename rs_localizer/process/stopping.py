"""Ctrl-C and SIGTERM as an orderly end.

Imports nothing that takes time, so that a program can begin with it.
"""

from __future__ import annotations

import abc
import contextlib
import os
import signal
from collections.abc import Iterator
from types import FrameType
from typing import ClassVar, Self

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
# What shells report of a program that a signal ended: 130 for Ctrl-C, 143 for SIGTERM.
_SIGNALLED = 128
INTERRUPTED = _SIGNALLED + signal.SIGINT
"""Exit code after Ctrl-C."""


class _Signals(abc.ABC):
    """Within ``with``, SIGINT and SIGTERM come to :meth:`_stop`.

    Leaving ignores both for good, since the process is about to end: a launch file and a terminal
    send theirs at the same time.
    """

    code: ClassVar[int] = 0
    """What shells report of a program that was ended by the signal that came, to whichever of
    several that are entered within each other; 0: none has come."""

    def __init__(self) -> None:
        self.requested = False
        self._at_once: tuple[int | None, str] | None = None

    def __enter__(self) -> Self:
        for number in _SIGNALS:
            signal.signal(number, self._take)
        return self

    def __exit__(self, *_: object) -> None:
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    @contextlib.contextmanager
    def at_once(self, code: int | None = 0, text: str = "") -> Iterator[None]:
        """While importing or compiling: a signal ends the process here and now.

        Both take long. Compiling cannot be interrupted, and an exception inside an import may be
        lost or come out as another one. No results exist meanwhile, and the caches on disk are
        written atomically.

        Args:
            code: exit code; None: :attr:`code`.
            text: written to stderr.
        """
        before, self._at_once = self._at_once, (code, text)
        try:
            yield
        finally:
            self._at_once = before

    def _take(self, number: int, frame: FrameType | None) -> None:
        _Signals.code = _SIGNALLED + number
        self._leave_if_at_once()
        first, self.requested = not self.requested, True
        if first:
            self._stop()

    def _leave_if_at_once(self) -> None:
        if self._at_once is not None:
            code, text = self._at_once
            os.write(2, text.encode())
            os._exit(self.code if code is None else code)

    @abc.abstractmethod
    def _stop(self) -> None:
        """Take the first signal."""


class StopSignals(_Signals):
    """The first signal raises KeyboardInterrupt wherever the main thread is; more change nothing.

    Enter it before ``rclpy.init``: rclpy's own handlers call those that they found.
    """

    def _stop(self) -> None:
        raise KeyboardInterrupt


class StopRequest(_Signals):
    """Signals set :attr:`requested` and raise nothing.

    An exception in the middle of a callback, or of rclpy's own clean-up, is lost or breaks it.
    """

    @contextlib.contextmanager
    def at_once(self, code: int | None = 0, text: str = "") -> Iterator[None]:
        """As of all; what was requested before it is not put off until it is over."""
        with super().at_once(code, text):
            if self.requested:
                self._leave_if_at_once()
            yield

    def _stop(self) -> None:
        pass
