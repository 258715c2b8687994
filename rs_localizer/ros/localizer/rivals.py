# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Who else broadcasts a transform that the node sends, and frames that have two parents."""

import math
import threading
import time
from collections import deque
from typing import Any

from rs_localizer.io.messages import stamp_ns
from rs_localizer.pipeline.published import Broadcast

# Our own come back from TF within this many.
_REMEMBERED = 1000
# Another parent of a frame that we send has ended if it has not come for so long (s).
_LASTS = 10.0
Link = tuple[str, str]  # parent and child


class Rivals:
    """Hears the transforms on TF; all methods may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sent: deque[tuple[int, tuple[float, ...]]] = deque(maxlen=_REMEMBERED)
        self._first_ns: int | None = None
        self._own: set[Link] = set()
        self._parents: dict[str, tuple[str, str]] = {}  # by child: the last one, the one before
        self._until: dict[str, float] = {}  # time.monotonic() until which others have ours
        self._static: dict[str, str] = {}  # parents of those that are, by child
        self._early: dict[Link, Any] = {}  # static ones, which come once, before we send
        self.static = ""
        """The contradiction that does not pass, in one sentence; empty: there is none."""

    def parent(self, item: Broadcast) -> str:
        """Return the parent that others give this child; its own if nobody does."""
        with self._lock:
            if time.monotonic() > self._until.get(item.child, math.inf):
                del self._parents[item.child], self._until[item.child]
            return self._parents.get(item.child, (item.parent, ""))[0]

    def send(self, message: Any) -> Any:
        """Remember a TransformStamped that is sent; return a static one that was there before."""
        with self._lock:
            link, sent_ns = _link(message), stamp_ns(message)
            self._own.add(link)
            self._sent.append((sent_ns, _numbers(message)))
            # Time may have gone back.
            self._first_ns = sent_ns if self._first_ns is None else min(self._first_ns, sent_ns)
            return self._early.pop(link, None)

    def hear(self, message: Any, *, static: bool) -> str:
        """Return what is wrong with a TransformStamped that has come, one sentence or nothing.

        Args:
            message: it.
            static: whether it is on ``/tf_static``.
        """
        with self._lock:
            link, text = _link(message), ""
            if link not in self._own:
                text = self._two_parents(*link, static)
                if static:
                    self._early[link] = message
            # What is not ours may yet be of the node before its restart.
            elif (stamp_ns(message), _numbers(message)) not in self._sent and (
                static or stamp_ns(message) > (self._first_ns or 0)
            ):
                text = f"another node broadcasts {link[0]} -> {link[1]}, too"
        self.static = text if static and text else self.static
        return text

    def _two_parents(self, parent: str, child: str, static: bool) -> str:
        """Describe a child that goes to and fro, or that is static below two parents."""
        last, before = self._parents.setdefault(child, (parent, ""))
        fixed = self._static.get(child, parent)
        if static:
            self._static[child] = parent
        if ours := [own for own, of in self._own if of == child]:
            self._parents[child] = parent, last
            lasts = math.inf if child in self._static else _LASTS
            self._until[child] = time.monotonic() + lasts
            return f"TF frame {child!r} has two parents, {ours[0]!r} and {parent!r}"
        if parent == last:
            return ""
        self._parents[child] = parent, last
        if parent != before and not (static and fixed != parent):
            return ""
        return f"TF frame {child!r} has two parents, {last!r} and {parent!r}"


def _link(message: Any) -> Link:
    return (message.header.frame_id.removeprefix("/"), message.child_frame_id.removeprefix("/"))


def _numbers(message: Any) -> tuple[float, ...]:
    t, q = message.transform.translation, message.transform.rotation
    return (t.x, t.y, t.z, q.x, q.y, q.z, q.w)
