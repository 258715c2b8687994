# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The frames of a recording and their transforms: tf2 without ROS.

Follows ``tf2::BufferCore`` of Jazzy, step by step and operation by operation, so that a replay
gives what the node gives: quaternions are composed and not matrices, a rotation goes through a
matrix where it is stored and where it is looked up, and between two samples positions are
interpolated linearly and rotations by slerp.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.io.messages import Make, make_header, make_quaternion, make_vector
from rs_localizer.io.messages import stamp_ns as stamp_of

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # x y z w


def plus(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def conjugate(q: Quaternion) -> Quaternion:
    return -q[0], -q[1], -q[2], q[3]


def times(p: Quaternion, q: Quaternion) -> Quaternion:
    return (
        p[3] * q[0] + p[0] * q[3] + p[1] * q[2] - p[2] * q[1],
        p[3] * q[1] + p[1] * q[3] + p[2] * q[0] - p[0] * q[2],
        p[3] * q[2] + p[2] * q[3] + p[0] * q[1] - p[1] * q[0],
        p[3] * q[3] - p[0] * q[0] - p[1] * q[1] - p[2] * q[2],
    )


def rotate(q: Quaternion, v: Vector) -> Vector:
    turned = (
        q[3] * v[0] + q[1] * v[2] - q[2] * v[1],
        q[3] * v[1] + q[2] * v[0] - q[0] * v[2],
        q[3] * v[2] + q[0] * v[1] - q[1] * v[0],
        -q[0] * v[0] - q[1] * v[1] - q[2] * v[2],
    )
    return times(turned, conjugate(q))[:3]


def _dot(p: Quaternion, q: Quaternion) -> float:
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3]


def slerp(p: Quaternion, q: Quaternion, ratio: float) -> Quaternion:
    cosine = _dot(p, q)
    if cosine < 0.0:  # the same rotation, nearer
        q = (-q[0], -q[1], -q[2], -q[3])
    cosine = min(abs(cosine) / math.sqrt(_dot(p, p) * _dot(q, q)), 1.0)
    angle = math.acos(cosine) * 2.0 / 2.0
    if angle == 0.0:
        return p
    scale = 1.0 / math.sin(angle)
    s, t = math.sin((1.0 - ratio) * angle), math.sin(ratio * angle)
    return (
        (p[0] * s + q[0] * t) * scale,
        (p[1] * s + q[1] * t) * scale,
        (p[2] * s + q[2] * t) * scale,
        (p[3] * s + q[3] * t) * scale,
    )


def through_matrix(q: Quaternion) -> Quaternion:
    """The quaternion of a quaternion's matrix, as tf2's Transform holds rotations."""
    x, y, z, w = q
    s = 2.0 / _dot(q, q)
    xs, ys, zs = x * s, y * s, z * s
    wx, wy, wz = w * xs, w * ys, w * zs
    xx, xy, xz = x * xs, x * ys, x * zs
    yy, yz, zz = y * ys, y * zs, z * zs
    m = (
        (1.0 - (yy + zz), xy - wz, xz + wy),
        (xy + wz, 1.0 - (xx + zz), yz - wx),
        (xz - wy, yz + wx, 1.0 - (xx + yy)),
    )
    trace = m[0][0] + m[1][1] + m[2][2]
    if trace > 0.0:
        s = math.sqrt(trace + 1.0)
        w, s = s * 0.5, 0.5 / s
        return (m[2][1] - m[1][2]) * s, (m[0][2] - m[2][0]) * s, (m[1][0] - m[0][1]) * s, w
    i = 1 if m[0][0] < m[1][1] else 0
    if m[i][i] < m[2][2]:
        i = 2
    j, k = (i + 1) % 3, (i + 2) % 3
    s = math.sqrt(m[i][i] - m[j][j] - m[k][k] + 1.0)
    result = [0.0, 0.0, 0.0, 0.0]
    result[i], s = s * 0.5, 0.5 / s
    result[3] = (m[k][j] - m[j][k]) * s
    result[j] = (m[j][i] + m[i][j]) * s
    result[k] = (m[k][i] + m[i][k]) * s
    return result[0], result[1], result[2], result[3]


# How far the squared norm of a quaternion may be from one; tf2 ignores those that are farther.
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
        """``a_from_b @ b_from_c = a_from_c``."""
        return Transform(
            self.rotation @ other.rotation, self.rotation @ other.translation + self.translation
        )


class Transforms(Protocol):
    """Answers what one frame is in another: TF, or the transforms of a recording."""

    def lookup(self, target: str, source: str, stamp_ns: int | None) -> Transform:
        """``target_from_source`` at a time; None: the latest.

        Raises:
            NotYetError: when it is known for earlier times, and may still come.
            TransformError: when it is not known for that time.
        """

    def moves(self, target: str, source: str) -> bool:
        """Whether the transform may differ from one time to the next.

        Raises:
            TransformError: when it is not known at all.
        """


def read_transform(message: Any) -> Transform:
    """The transform of a geometry_msgs/Transform.

    Raises:
        TransformError: for a number that is not finite, or no unit quaternion.
    """
    t, q = message.translation, message.rotation
    return from_numbers((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))


def from_numbers(
    translation: tuple[float, float, float], quaternion: tuple[float, float, float, float]
) -> Transform:
    """The transform of a translation in m and a quaternion ``x y z w``.

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
    """A geometry_msgs/TransformStamped."""
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
    """Transforms by the names of frames (see :class:`Transforms`).

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
            if static:
                self._tracks[child] = _Track(static=link)
            else:
                self._tracks.setdefault(child, _Track()).add(stamp_of(stamped), link)

    def lookup(self, target: str, source: str, stamp_ns: int | None) -> Transform:
        """``target_from_source`` at a time; None: the latest that all its links have."""
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
        """Whether a link between the two frames comes with a time."""
        target, source = target.removeprefix("/"), source.removeprefix("/")
        return target != source and self._latest(target, source) is not None

    def _latest(self, target: str, source: str) -> int | None:
        """The last time (ns) at which all links are known; None: they are all static."""
        self._check(target, source)
        chains = [self._frames_above(name) for name in (target, source)]
        meeting = next((name for name in chains[0] if name in chains[1]), None)
        if meeting is None:
            raise _unconnected(target, source)
        tracks = [self._tracks[name] for chain in chains for name in chain[: chain.index(meeting)]]
        return min((t.stamps[-1] for t in tracks if t.static is None), default=None)

    def _check(self, *names: str) -> None:
        for name in names:
            if name not in self._tracks and name not in self._parents:
                frames = ", ".join(sorted(self._parents | set(self._tracks))) or "none"
                raise TransformError(f"frame {name!r} does not exist; there are {frames}")

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
