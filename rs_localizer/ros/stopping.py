"""Ctrl-C and SIGTERM as an orderly end."""

from __future__ import annotations

import abc
import contextlib
import os
import signal
from collections.abc import Iterator
from types import FrameType
from typing import Self

import rclpy

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def shut_down() -> None:
    """End the default context, if nobody else has."""
    # After a signal rclpy does the same in a thread of its own, and whoever comes second fails.
    with contextlib.suppress(RuntimeError):
        rclpy.try_shutdown()


class _Signals(abc.ABC):
    """Within ``with``, SIGINT and SIGTERM come to :meth:`_stop`.

    Leaving ignores both for good, since the process is about to end: a launch file and a terminal
    send theirs at the same time.
    """

    def __init__(self) -> None:
        self.requested = False

    def __enter__(self) -> Self:
        for number in _SIGNALS:
            signal.signal(number, self._stop)
        return self

    def __exit__(self, *_: object) -> None:
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    @abc.abstractmethod
    def _stop(self, number: int, frame: FrameType | None) -> None: ...


class StopSignals(_Signals):
    """The first signal raises KeyboardInterrupt wherever the main thread is; more change nothing.

    Enter it before ``rclpy.init``: rclpy's own handlers, which wake a waiting executor, call
    those that they found.
    """

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if not self.requested:
            self.requested = True
            raise KeyboardInterrupt


class StopRequest(_Signals):
    """Signals set :attr:`requested` and raise nothing.

    An exception in the middle of a callback, or of rclpy's own clean-up, is lost or breaks it.
    """

    _at_once = False

    @contextlib.contextmanager
    def at_once(self) -> Iterator[None]:
        """While compiling: a signal ends the process here and now, with exit code 0.

        Compiling takes up to a minute and cannot be interrupted. Nothing is published meanwhile,
        and the cache on disk is written atomically.
        """
        self._at_once = True
        try:
            yield
        finally:
            self._at_once = False

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self._at_once:
            os._exit(0)
        self.requested = True
