# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Refusals: counted by reason, and logged without flooding the log."""

import math
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Collection

_PERIOD = 5.0  # s between two log lines of a reason


class Refusals:
    """Counts refusals and passes on one text per reason and period.

    All methods may be called from any thread.

    Args:
        log: takes a line of text.
        clock: s, monotonic. Not ROS time, which stands still or jumps back with a recording.
    """

    def __init__(
        self, log: Callable[[str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._log, self._clock = log, clock
        self._lock = threading.Lock()
        # By reason and subject: when it was logged last, and how often it was not since; by reason:
        # when it was noticed last, and the detail.
        self._logged: dict[tuple[str, str], tuple[float, int]] = {}
        self._latest: dict[str, tuple[float, str]] = {}

    def add(self, reason: str, detail: str) -> None:
        """Count one more; ``detail`` is one sentence."""
        with self._lock:
            self.counts[reason] += 1
        self.notice(reason, detail)

    def notice(self, reason: str, detail: str, subject: str = "") -> None:
        """Log an oddity that is no refusal in the same way; of few subjects, each by itself."""
        with self._lock:
            now = self._clock()
            self._latest[reason] = now, detail
            when, silent = self._logged.get((reason, subject), (-math.inf, 0))
            said = now - when < _PERIOD
            self._logged[reason, subject] = (when, silent + 1) if said else (now, 0)
        if not said:
            more = f" ({silent} more since the last report)" if silent else ""
            self._log(f"{reason}: {detail}{more}")

    def recent(self, reasons: Collection[str], seconds: float) -> dict[str, str]:
        """Return those of these reasons that were noticed lately, with their latest details."""
        with self._lock:
            since = self._clock() - seconds
            latest = {reason: self._latest.get(reason) for reason in reasons}
            return {k: item[1] for k, item in latest.items() if item and item[0] >= since}


def describe(error: Exception) -> str:
    """Describe an unforeseen error in one line: what, and where."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    return f"{error!r} in {where.name}, {where.filename}:{where.lineno}"
