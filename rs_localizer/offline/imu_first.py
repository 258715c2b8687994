"""The inertial readings of an exposure before its frame, as far as a recording has them.

A live node waits for them (``imu.wait``); offline, a frame waits until the recording has gone on
for a while, so that it gets all that there are.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any

Item = tuple[str, int, Any]
"""Topic, time of recording in ns, message."""

LOOK_AHEAD = 1.0
"""How far the recording is read before a frame goes without its readings, in s."""


def imu_first(
    messages: Iterable[Item], imu: str | None, awaits: Callable[[Item], bool]
) -> Iterator[Item]:
    """The messages in their order, but for those of ``imu``, which do not wait for the others.

    Args:
        messages: by their times of recording.
        imu: topic; None: there is none.
        awaits: whether a message that is next still needs readings. It is asked when all before it
            have been dealt with.
    """
    waiting: deque[Item] = deque()
    for item in messages:
        if item[0] == imu:
            yield item
        else:
            waiting.append(item)
        latest_ns = item[1] - round(LOOK_AHEAD * 1e9)
        while waiting and (waiting[0][1] <= latest_ns or imu is None or not awaits(waiting[0])):
            yield waiting.popleft()
    yield from waiting
