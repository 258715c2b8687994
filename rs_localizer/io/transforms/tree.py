"""The frames of a recording and their transforms: tf2 without ROS.

Follows ``tf2::BufferCore`` of Jazzy, step by step and operation by operation, so that a replay
gives what the node gives: quaternions are composed and not matrices, a rotation goes through a
matrix where it is stored and where it is looked up, and between two samples positions are
interpolated linearly and rotations by slerp.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from typing import Any

from rs_localizer.io.messages import stamp_ns as stamp_of
from rs_localizer.io.transforms.rigid import Transform, TransformError, from_numbers
from rs_localizer.io.transforms.tf2_arithmetic import (
    Quaternion,
    Vector,
    conjugate,
    plus,
    rotate,
    slerp,
    through_matrix,
    times,
)

# Longer chains are loops.
_MOST_LINKS = 1000
_NOWHERE: tuple[Vector, Quaternion] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class _Link:
    """A frame in its parent."""

    parent: str
    translation: Vector
    rotation: Quaternion


@dataclass(slots=True)
class _Track:
    """A frame in its parent over time: one link for ever, or samples in the order of time."""

    static: _Link | None = None
    stamps: list[int] = field(default_factory=list)  # ns
    links: list[_Link] = field(default_factory=list)

    def add(self, stamp: int, link: _Link) -> None:
        self.static = None
        index = bisect_right(self.stamps, stamp)
        self.stamps.insert(index, stamp)
        self.links.insert(index, link)

    def at(self, stamp: int | None) -> _Link:
        if self.static is not None:
            return self.static
        if stamp is None or stamp == self.stamps[-1]:
            return self.links[-1]
        if stamp == self.stamps[0]:
            return self.links[0]
        index = bisect_right(self.stamps, stamp)
        if not 0 < index < len(self.stamps):
            raise TransformError(
                f"is known from {self.stamps[0] * 1e-9:.3f} s to {self.stamps[-1] * 1e-9:.3f} s, "
                f"not at {stamp * 1e-9:.3f} s"
            )
        older, newer = self.links[index - 1], self.links[index]
        if older.parent != newer.parent:
            return older
        before, after = self.stamps[index - 1 : index + 1]
        ratio = float(stamp - before) / float(after - before)
        rest = 1.0 - ratio
        a, b = older.translation, newer.translation
        between = (
            rest * a[0] + ratio * b[0],
            rest * a[1] + ratio * b[1],
            rest * a[2] + ratio * b[2],
        )
        return _Link(older.parent, between, slerp(older.rotation, newer.rotation, ratio))


class TransformTree:
    """Transforms by the names of frames (see :class:`rs_localizer.io.transforms.rigid.Transforms`).

    A slash before a name, as ROS 1 has it, says nothing.
    """

    def __init__(self) -> None:
        self._tracks: dict[str, _Track] = {}  # by child
        self._parents: set[str] = set()

    def add(self, message: Any, *, static: bool) -> None:
        """Take the transforms of a tf2_msgs/TFMessage; like tf2, leave out those that are none."""
        for stamped in message.transforms:
            parent = stamped.header.frame_id.removeprefix("/")
            child = stamped.child_frame_id.removeprefix("/")
            t, q = stamped.transform.translation, stamped.transform.rotation
            translation, rotation = (t.x, t.y, t.z), (q.x, q.y, q.z, q.w)
            try:
                from_numbers(translation, rotation)
            except TransformError:
                continue
            if not parent or not child or parent == child:
                continue
            link = _Link(parent, translation, through_matrix(rotation))
            self._parents.add(parent)
            track = self._tracks.setdefault(child, _Track())
            if static:
                self._tracks[child] = _Track(static=link)
            else:
                track.add(stamp_of(stamped), link)

    def lookup(self, target: str, source: str, stamp_ns: int | None) -> Transform:
        """``target_from_source`` at a time; None: the latest that all its links have.

        Raises:
            TransformError: when it is not known for that time.
        """
        target, source = target.removeprefix("/"), source.removeprefix("/")
        if target == source:
            return from_numbers((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        if stamp_ns is None:
            stamp_ns = self._latest(target, source)
        self._check(target, source)
        to_source, top, gap = self._climb(source, target, stamp=stamp_ns)
        translation, rotation = _compose(to_source)
        if top != target:
            to_target, met, other_gap = self._climb(target, top, source, stamp=stamp_ns)
            if met == source:  # the source lies above the target: its own way up does not count
                translation, rotation = _NOWHERE
            elif met != top:
                raise other_gap or gap or _unconnected(target, source)
            top_translation, top_rotation = _compose(to_target)
            back = conjugate(top_rotation)
            x, y, z = top_translation
            inverse = rotate(back, (-x, -y, -z))
            translation = plus(rotate(back, translation), inverse)
            rotation = times(back, rotation)
        return from_numbers(translation, through_matrix(rotation))

    def moves(self, target: str, source: str) -> bool:
        """Whether a link between the two frames comes with a time.

        Raises:
            TransformError: when they are not connected.
        """
        target, source = target.removeprefix("/"), source.removeprefix("/")
        return target != source and self._latest(target, source) is not None

    def _latest(self, target: str, source: str) -> int | None:
        """The last time (ns) at which all links are known; None: they are all static."""
        self._check(target, source)
        ways = [self._frames_above(name) for name in (target, source)]
        meeting = next((name for name in ways[0] if name in ways[1]), None)
        if meeting is None:
            raise _unconnected(target, source)
        tracks = [self._tracks[name] for way in ways for name in way[: way.index(meeting)]]
        return min((t.stamps[-1] for t in tracks if t.static is None), default=None)

    def _check(self, *names: str) -> None:
        for name in names:
            if name not in self._tracks and name not in self._parents:
                known = ", ".join(sorted(self._parents | set(self._tracks))) or "none"
                raise TransformError(f"frame {name!r} does not exist; there are {known}")

    def _frames_above(self, name: str) -> list[str]:
        """A frame and all that it hangs on, by the latest links."""
        names = [name]
        while name in self._tracks:
            name = self._tracks[name].at(None).parent
            names.append(name)
            if len(names) > _MOST_LINKS:
                raise TransformError(f"the frames above {names[0]!r} are a loop")
        return names

    def _climb(
        self, name: str, *ends: str, stamp: int | None
    ) -> tuple[list[_Link], str, TransformError | None]:
        """Links from a frame up to one of the ends, the root, or where the time is not known.

        With them, the frame that was reached, and why it was not the root.
        """
        links: list[_Link] = []
        while name in self._tracks and name not in ends:
            try:
                link = self._tracks[name].at(stamp)
            except TransformError as error:
                return links, name, TransformError(f"frame {name!r} {error}")
            links.append(link)
            name = link.parent
            if len(links) > _MOST_LINKS:
                raise TransformError("the frames are a loop")
        return links, name, None


def _unconnected(target: str, source: str) -> TransformError:
    return TransformError(f"frames {target!r} and {source!r} are not connected")


def _compose(links: list[_Link]) -> tuple[Vector, Quaternion]:
    translation, rotation = _NOWHERE
    for link in links:
        translation = plus(rotate(link.rotation, translation), link.translation)
        rotation = times(link.rotation, rotation)
    return translation, rotation
