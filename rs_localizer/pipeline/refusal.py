# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A refused message and its reason; the call that reports oddities."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from rs_localizer.core.reasons import ImuReason, Notice, Reason
from rs_localizer.io.clouds import EmptyCloudError
from rs_localizer.io.messages import MessageError

Read = TypeVar("Read")


@dataclass(frozen=True, slots=True)
class Refusal:
    """A message without a result; false in a condition. What its reason means: :mod:`.reasons`."""

    reason: Reason
    detail: str  # one sentence that says what was found

    def __bool__(self) -> Literal[False]:
        return False


Notify = Callable[[Notice | ImuReason, str], None]
"""Told of what is odd, with one sentence. Frames are localized all the same."""


def unheard(notice: Notice | ImuReason, text: str) -> None:
    """Tell nobody."""


def read_or_refuse(read: Callable[[Any], Read], message: Any, reason: Reason) -> Read | Refusal:
    """Read a message, or refuse it for this reason, or as empty."""
    try:
        return read(message)
    except EmptyCloudError as error:
        return Refusal(Reason.EMPTY_CLOUD, str(error))
    except MessageError as error:
        return Refusal(reason, str(error))
