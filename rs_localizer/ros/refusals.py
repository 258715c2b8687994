"""What was refused: counted by reason, and logged without flooding the log."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable

_PERIOD = 5.0  # s between two log lines of one reason


class Refusals:
    """Counts refusals and passes on one text per reason and period.

    Args:
        log: takes a line of text.
        clock: s, monotonic. Not ROS time, which stands still or jumps back with a recording.
    """

    def __init__(
        self, log: Callable[[str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._log = log
        self._clock = clock
        self._logged: dict[str, tuple[float, int]] = {}  # reason: when, and the count then

    def add(self, reason: str, detail: str) -> None:
        """Count one more; ``detail`` is one sentence."""
        self.counts[reason] += 1
        now, count = self._clock(), self.counts[reason]
        when, before = self._logged.get(reason, (-math.inf, count - 1))
        if now - when < _PERIOD:
            return
        self._logged[reason] = now, count
        more = count - before - 1
        self._log(f"{reason}: {detail}" + (f" ({more} more since the last report)" if more else ""))
