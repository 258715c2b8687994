# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What all readers of messages share: the error, the stamp, and the headers.

Messages are taken by their attributes, so that those of rclpy and those of rosbags, which differ
only in their containers, are read by the same code.
"""

from collections.abc import Callable
from typing import Any

Make = Callable[..., Any]
"""Builds a message: ``make("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0)``.

Every field is given; numbers in arrays come as NumPy arrays of the field's type.
"""

_NANOSECONDS = 1_000_000_000


class MessageError(ValueError):
    """A message that cannot be used; the text says what was found."""


def stamp_ns(message: Any) -> int:
    """Stamp of a message's header in integer nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * _NANOSECONDS + int(stamp.nanosec)


def frame_id(message: Any, what: str) -> str:
    """Frame of a message's header; without a name, nothing can be said about poses in it."""
    name = str(message.header.frame_id)
    if not name:
        raise MessageError(f"header.frame_id is empty; it must name {what}")
    return name


def make_header(make: Make, stamp: int, frame: str) -> Any:
    """A header with a stamp in nanoseconds."""
    seconds, nanoseconds = divmod(stamp, _NANOSECONDS)
    return make(
        "std_msgs/msg/Header",
        stamp=make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds),
        frame_id=frame,
    )
