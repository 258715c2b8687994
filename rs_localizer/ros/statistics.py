"""What became of the frames, for the diagnostics."""

from __future__ import annotations

import threading
import time
from collections import Counter

from rs_localizer.frames import Refusal
from rs_localizer.io.outputs import Frame
from rs_localizer.ros.refusals import Refusals


class Statistics:
    """Counts frames; all methods may be called from any thread.

    Args:
        refusals: logs and counts what is refused.
    """

    def __init__(self, refusals: Refusals) -> None:
        self._refusals = refusals
        self._lock = threading.Lock()
        self.frames_in: Counter[str] = Counter()
        self.frames_replaced: Counter[str] = Counter()
        self.frames_out: Counter[str] = Counter()
        self.latency = 0.0

    def received(self, topic: str) -> None:
        with self._lock:
            self.frames_in[topic] += 1

    def replaced(self, topic: str) -> None:
        """A frame gave way to a newer one before it was looked at."""
        with self._lock:
            self.frames_replaced[topic] += 1

    def refused(self, topic: str, refusal: Refusal) -> None:
        self._refusals.add(refusal.reason, refusal.detail)

    def answered(self, topic: str, frame: Frame, received: float) -> None:
        """A frame was published that had been received at this time.monotonic()."""
        with self._lock:
            self.frames_out[topic] += 1
            self.latency = time.monotonic() - received
