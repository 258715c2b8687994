"""Ctrl-C and SIGTERM as an orderly end."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Self

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopSignals:
    """Within ``with``, the first SIGINT or SIGTERM raises KeyboardInterrupt wherever the main
    thread is, so that compiling ends as well; more of them change nothing.

    Enter it before ``rclpy.init``: rclpy's own handlers, which wake a waiting executor, call
    those that they found. Leaving it ignores both signals for good, since the process is about to
    end: a launch file and a terminal send theirs at the same time.
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

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if not self.requested:
            self.requested = True
            raise KeyboardInterrupt
