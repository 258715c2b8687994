"""A message without a result, and why."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from rs_localizer.io.messages import MessageError

Read = TypeVar("Read")

BAD_IMAGE = "bad_image"
"""Of an image that cannot be read."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """A message without a result; false in a condition.

    Beside the localizer's own reasons there are ``no_camera_info``, ``empty_cloud``, ``bad_cloud``
    (a message that cannot be read) and ``no_transform`` (from the camera to ``base_frame``); of
    keypoints ``no_map``, ``bad_keypoints`` (that cannot be read, or not be compared with the map)
    and ``no_matches``; of images ``bad_image``. What they mean: :mod:`.reasons`.
    """

    reason: str
    detail: str  # one sentence that says what was found

    def __bool__(self) -> Literal[False]:
        return False


@dataclass(frozen=True, slots=True)
class Waiting(Refusal):
    """A localized frame whose mounting is known for earlier times only.

    It is refused, unless somebody asks for it again.
    """

    again: Callable[[], Any]  # the result or another refusal
    patience: float  # s, for which this makes sense


def read_or_refuse(read: Callable[[Any], Read], message: Any, reason: str) -> Read | Refusal:
    """What is read of a message; refused for this reason if it cannot be."""
    try:
        return read(message)
    except MessageError as error:
        return Refusal(reason, str(error))
