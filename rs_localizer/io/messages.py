# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Shared parts of readers of messages: the error, the stamp, and the headers.

Messages are read by their attributes. So the same code reads messages of rclpy and of rosbags,
which differ only in their containers.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array

Make = Callable[..., Any]
"""Builds a message: ``make("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0)``.

Every field is given; numbers in arrays come as NumPy arrays of the field's type.
"""

_NANOSECONDS = 1_000_000_000


class MessageError(ValueError):
    """A message that cannot be used; the text says what was found."""


def stamp_ns(message: Any) -> int:
    """Return the stamp of a message's header in integer nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * _NANOSECONDS + int(stamp.nanosec)


def frame_id(message: Any, what: str) -> str:
    """Return the frame of a message's header, or refuse an empty one: poses need a frame."""
    name = str(message.header.frame_id)
    if not name:
        raise MessageError(f"header.frame_id is empty; it must name {what}")
    return name


def make_header(make: Make, stamp: int, frame: str) -> Any:
    """Return a header with a stamp in nanoseconds."""
    seconds, nanoseconds = divmod(stamp, _NANOSECONDS)
    return make(
        "std_msgs/msg/Header",
        stamp=make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds),
        frame_id=frame,
    )


def make_vector(make: Make, vector: Array, kind: str = "Vector3") -> Any:
    """Return a Vector3, or a Point, of geometry_msgs with the values of a vector (3,)."""
    x, y, z = vector.tolist()
    return make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def make_quaternion(make: Make, rotation: Array) -> Any:
    """Return a geometry_msgs/Quaternion of a rotation matrix (3,3)."""
    from rs_localizer.core import so3  # kernels, which readers do not need

    x, y, z, w = so3.quaternion(np.ascontiguousarray(rotation)).tolist()
    return make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
