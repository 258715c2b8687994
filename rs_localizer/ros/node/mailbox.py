"""Where messages wait for the worker: the newest wins, and what it replaced is counted."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

State = TypeVar("State")
Item = TypeVar("Item")
Update = Callable[[State], None]


@dataclass(frozen=True, slots=True)
class Work(Generic[State, Item]):
    """What is to be done next: the updates, then the frame."""

    updates: Iterable[Update[State]]
    frame: Item | None
    session: int  # see :meth:`Mailbox.is_current`


class Mailbox(Generic[State, Item]):
    """Bounded: it holds one frame of each topic and one update of each kind.

    All methods may be called from any thread; only :meth:`take` waits.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._updates: dict[str, Update[State]] = {}
        self._frames: dict[str, Item] = {}
        self._session = 0
        self._closed = self._woken = False

    def update(self, kind: str, update: Update[State]) -> None:
        """Have this done before the next frame, after all updates of other kinds so far.

        An older one of the same kind that still waits is dropped: an update says how things are
        now, not what has changed.
        """
        with self._changed:
            self._updates.pop(kind, None)
            self._updates[kind] = update
            self._changed.notify()

    def put(self, topic: str, frame: Item) -> bool:
        """Add a frame; whether it replaced one of its topic, whose place it then takes."""
        with self._changed:
            replaced = topic in self._frames
            self._frames[topic] = frame
            self._changed.notify()
            return replaced

    def take(self, timeout: float | None = None) -> Work[State, Item] | None:
        """Wait for all updates, and the oldest frame if there is any; None once it is closed.

        After ``timeout`` (s), or when it is woken, it may be nothing that is to be done.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: self._updates or self._frames or self._closed or self._woken, timeout
            )
            self._woken = False
            if self._closed:
                return None
            updates, self._updates = self._updates, {}
            oldest = next(iter(self._frames), None)
            frame = None if oldest is None else self._frames.pop(oldest)
            return Work(updates.values(), frame, self._session)

    def wake(self) -> None:
        """Let :meth:`take` return, whatever there is."""
        with self._changed:
            self._woken = True
            self._changed.notify()

    def drop_frames(self) -> int:
        """Forget the frames that wait, how many there are, and end the session of the one that is
        worked on.
        """
        with self._changed:
            dropped = len(self._frames)
            self._frames.clear()
            self._session += 1
            return dropped

    def is_current(self, work: Work[State, Item]) -> bool:
        """Whether its result is still wanted."""
        with self._changed:
            return work.session == self._session and not self._closed

    def close(self) -> None:
        """Drop everything; :meth:`take` returns None from now on."""
        with self._changed:
            self._closed = True
            self._updates, self._frames = {}, {}
            self._changed.notify_all()
