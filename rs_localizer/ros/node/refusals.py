# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Refusals: counted by reason, and logged without flooding the log."""

import re
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass

_PERIOD = 5.0  # s between two log lines that say the same
# Different texts of one reason that are logged in a period. More come from a sender who writes
# something new into every message, and share one line.
_MOST_KINDS = 8
_OTHERS = ""


@dataclass(slots=True)
class _Logged:
    """The last line of a kind, and how many like it have not been logged since."""

    when: float
    silent: int = 0


class Refusals:
    """Counts refusals and passes on one text per kind and period.

    Refusals of one reason whose details differ only in numbers are of one kind. All methods may be
    called from any thread.

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
        self._lock = threading.Lock()
        self._logged: dict[str, dict[str, _Logged]] = {}  # by reason and kind
        self._latest: dict[str, tuple[float, str]] = {}  # when, and the detail, by reason

    def add(self, reason: str, detail: str) -> None:
        """Count one more; ``detail`` is one sentence."""
        with self._lock:
            self.counts[reason] += 1
        self.notice(reason, detail)

    def notice(self, reason: str, detail: str) -> None:
        """Log an oddity that is no refusal in the same way."""
        with self._lock:
            self._latest[reason] = self._clock(), detail
            line = self._line(reason, detail)
        if line is not None:
            self._log(line)

    def recent(self, reasons: Collection[str], seconds: float) -> dict[str, str]:
        """Return those of these reasons that were noticed lately, with their latest details."""
        with self._lock:
            since = self._clock() - seconds
            latest = {reason: self._latest.get(reason) for reason in reasons}
            return {k: item[1] for k, item in latest.items() if item and item[0] >= since}

    def _line(self, reason: str, detail: str) -> str | None:
        """Return a line for the log; None if it has been said."""
        now = self._clock()
        kinds = self._logged.setdefault(reason, {})
        kind = re.sub(r"\d+", "0", detail)
        if kind not in kinds:
            kind = _room_for(kind, kinds, now)
        last = kinds.get(kind)
        if last is not None and now - last.when < _PERIOD:
            last.silent += 1
            return None
        more = f" ({last.silent} more since the last report)" if last and last.silent else ""
        kinds[kind] = _Logged(now)
        return f"{reason}: {detail}{more}"


def _room_for(kind: str, kinds: dict[str, _Logged], now: float) -> str:
    """Return the name under which a new kind is kept, so that there are never many."""
    if len(kinds) < _MOST_KINDS:
        return kind
    for old in [k for k, logged in kinds.items() if now - logged.when >= _PERIOD and k != _OTHERS]:
        del kinds[old]
    return kind if len(kinds) < _MOST_KINDS else _OTHERS


def describe(error: Exception) -> str:
    """Describe an unforeseen error in one line: what, and where."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    return f"{error!r} in {where.name}, {where.filename}:{where.lineno}"
