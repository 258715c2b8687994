# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms, and the frames of a recording: what tf2 answers, without ROS.

Between two samples positions are interpolated linearly and rotations by slerp, as tf2 does; both
agree to rounding.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.io.messages import Make, make_header, make_quaternion, make_vector
from rs_localizer.io.messages import stamp_ns as stamp_of

# Tolerance of a quaternion's squared norm; tf2 ignores those that are farther from one.
_NORM_TOLERANCE = 1e-2


class TransformError(ValueError):
    """There is no such transform; the text names the frames and says why."""


class NotYetError(TransformError):
    """The transform is known for earlier times only."""


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """A rigid transform: ``x_target = rotation @ x_source + translation``."""

    rotation: Array  # (3,3)
    translation: Array  # (3,) m

    def inverse(self) -> Transform:
        return Transform(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: Transform) -> Transform:
        """Return ``a_from_c`` of ``a_from_b @ b_from_c``."""
        return Transform(
            self.rotation @ other.rotation, self.rotation @ other.translation + self.translation
        )


class Transforms(Protocol):
    """Answers what one frame is in another: TF, or the transforms of a recording."""

    def lookup(self, target: str, source: str, stamp_ns: int | None) -> Transform:
        """Return ``target_from_source`` at a time (ns); None: the latest.

        Raises:
            NotYetError: when it is known for earlier times, and may still come.
            TransformError: when it is not known for that time.
        """

    def moves(self, target: str, source: str) -> bool:
        """Return True if the transform may change with time.

        Raises:
            TransformError: when it is not known at all.
        """


def read_transform(message: Any) -> Transform:
    """Return the transform of a geometry_msgs/Transform.

    Raises:
        TransformError: for a number that is not finite, or no unit quaternion.
    """
    t, q = message.translation, message.rotation
    return from_numbers((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))


def from_numbers(
    translation: tuple[float, float, float], quaternion: tuple[float, float, float, float]
) -> Transform:
    """Return the transform of a translation in m and a quaternion ``x y z w``.

    Raises:
        TransformError: for a number that is not finite, or no unit quaternion.
    """
    if not all(map(math.isfinite, translation)):
        raise TransformError(f"the translation {translation} is not finite")
    x, y, z, w = quaternion
    square = x * x + y * y + z * z + w * w
    if not abs(square - 1.0) < _NORM_TOLERANCE:  # NaN is wrong, too
        raise TransformError(f"the quaternion {quaternion} is not a rotation")
    s = 2.0 / square
    rotation = np.array(
        [
            [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
            [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)],
            [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)],
        ]
    )
    return Transform(rotation, np.array(translation, dtype=np.float64))


def make_transform(
    make: Make, stamp_ns: int, parent: str, child: str, parent_from_child: Transform
) -> Any:
    """Return a geometry_msgs/TransformStamped."""
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=make_header(make, stamp_ns, parent),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=make_vector(make, parent_from_child.translation),
            rotation=make_quaternion(make, parent_from_child.rotation),
        ),
    )


class UnusableTransforms:
    """Transforms that have come and are none, which tf2 leaves out as if they had not come."""

    def __init__(self) -> None:
        self._faults: dict[tuple[str, str], str] = {}  # by parent and child, the last one

    def read(self, stamped: Any) -> Transform | None:
        """Read a geometry_msgs/TransformStamped; keep the fault of an unusable one, return None."""
        names = _name(stamped.header.frame_id), _name(stamped.child_frame_id)
        try:
            link = read_transform(stamped.transform)
        except TransformError as error:
            self._faults[names] = f"of {names[1]!r} in {names[0]!r} on TF {error}"
            return None
        self._faults.pop(names, None)
        return link

    def explain(self, text: str) -> str:
        """Return a sentence on frames without a transform, with the last of the faults."""
        faults = [fault for fault in list(self._faults.values()) if fault not in text]
        return f"{text}; {faults[-1]}" if faults else text


class _Links(NamedTuple):
    """A frame in its parent over time: for ever, or samples in the order of time."""

    stamps: list[int]  # ns; none: the only link holds for ever
    links: list[tuple[str, Transform]]  # parent, parent_from_child

    def at(self, stamp: int | None) -> tuple[str, Transform]:
        """Return parent and transform at a time (ns); None: the latest."""
        if not self.stamps or stamp is None or stamp == self.stamps[-1]:
            return self.links[-1]
        index = bisect_right(self.stamps, stamp)
        if not 0 < index < len(self.stamps):
            raise TransformError(
                f"is known from {self.stamps[0] * 1e-9:.3f} s to {self.stamps[-1] * 1e-9:.3f} s, "
                f"not at {stamp * 1e-9:.3f} s"
            )
        (parent, older), (other, newer) = self.links[index - 1 : index + 1]
        before, after = self.stamps[index - 1 : index + 1]
        if parent != other or stamp == before:
            return parent, older
        share = (stamp - before) / (after - before)
        turned = so3.log(np.ascontiguousarray(older.rotation.T @ newer.rotation))
        rotation = older.rotation @ so3.exp(share * turned)
        translation = (1.0 - share) * older.translation + share * newer.translation
        return parent, Transform(rotation, translation)


class TransformTree:
    """Transforms by the names of frames (see :class:`Transforms`).

    A slash before a name, as ROS 1 has it, says nothing.
    """

    def __init__(self) -> None:
        self._tracks: dict[str, _Links] = {}  # by child
        self._parents: set[str] = set()
        self._unusable = UnusableTransforms()

    def add(self, message: Any, *, static: bool) -> None:
        """Take the transforms of a tf2_msgs/TFMessage; like tf2, leave out those that are none."""
        for stamped in message.transforms:
            parent, child = _name(stamped.header.frame_id), _name(stamped.child_frame_id)
            link = self._unusable.read(stamped)
            if link is None or not parent or not child or parent == child:
                continue
            self._parents.add(parent)
            track = self._tracks.get(child)
            if static or track is None or not track.stamps:  # the first, or one that was static
                track = self._tracks[child] = _Links([], [])
            index = 0
            if not static:
                stamp = stamp_of(stamped)
                index = bisect_right(track.stamps, stamp)
                track.stamps.insert(index, stamp)
            track.links.insert(index, (parent, link))

    def lookup(self, target: str, source: str, stamp_ns: int | None) -> Transform:
        """Return ``target_from_source`` at a time (ns); None: the latest that all links have."""
        target, source = _name(target), _name(source)
        if target == source:
            return Transform(np.eye(3), np.zeros(3))
        if stamp_ns is None:
            stamp_ns = self._latest(target, source)
        self._check(target, source)
        of_source, gap = self._above(source, stamp_ns)
        of_target, other_gap = self._above(target, stamp_ns)
        meeting = next((name for name in of_source if name in of_target), None)
        if meeting is None:
            raise other_gap or gap or self._unconnected(target, source)
        return of_target[meeting].inverse() @ of_source[meeting]

    def moves(self, target: str, source: str) -> bool:
        """Return True if a link between the two frames comes with a time."""
        target, source = _name(target), _name(source)
        return target != source and self._latest(target, source) is not None

    def _latest(self, target: str, source: str) -> int | None:
        """Return the last time (ns) at which all links are known; None if they are all static."""
        self._check(target, source)
        ways = [list(self._above(name, None)[0]) for name in (target, source)]
        meeting = next((name for name in ways[0] if name in ways[1]), None)
        if meeting is None:
            raise self._unconnected(target, source)
        tracks = [self._tracks[name] for way in ways for name in way[: way.index(meeting)]]
        return min((track.stamps[-1] for track in tracks if track.stamps), default=None)

    def _check(self, *names: str) -> None:
        for name in names:
            if name not in self._tracks and name not in self._parents:
                frames = ", ".join(sorted(self._parents | set(self._tracks))) or "none"
                text = f"frame {name!r} does not exist; there are {frames}"
                raise TransformError(self._unusable.explain(text))

    def _above(
        self, name: str, stamp_ns: int | None
    ) -> tuple[dict[str, Transform], TransformError | None]:
        """Return a frame in itself and in its ancestors, up to the root or a gap, and that gap."""
        here = Transform(np.eye(3), np.zeros(3))
        found = {name: here}
        while name in self._tracks:
            try:
                parent, link = self._tracks[name].at(stamp_ns)
            except TransformError as error:
                return found, TransformError(f"frame {name!r} {error}")
            if parent in found:
                raise TransformError(f"the frames above {name!r} are a loop")
            name, here = parent, link @ here
            found[name] = here
        return found, None

    def _unconnected(self, target: str, source: str) -> TransformError:
        text = f"frames {target!r} and {source!r} are not connected"
        return TransformError(self._unusable.explain(text))


def _name(frame: str) -> str:
    return str(frame).removeprefix("/")
