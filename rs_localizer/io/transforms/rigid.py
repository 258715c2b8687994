"""Rigid transforms between named frames, and where they come from.

A transform ``target_from_source`` is the pose of the source frame in the target frame. It is what
geometry_msgs/TransformStamped holds with ``header.frame_id`` = target and ``child_frame_id`` =
source, and what tf2's ``lookup_transform(target, source, time)`` answers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.io.messages import Make, make_header

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
    x, y, z = parent_from_child.translation.tolist()
    qx, qy, qz, qw = so3.quaternion(np.ascontiguousarray(parent_from_child.rotation)).tolist()
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=make_header(make, stamp_ns, parent),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        ),
    )
