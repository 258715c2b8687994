# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamps out of order."""

from typing import Any
from unittest.mock import Mock

from rs_localizer.pipeline.stream import Stream

SECOND = 10**9


class Heard:
    """A stream, and what it told."""

    def __init__(self) -> None:
        self.told: list[tuple[str, str]] = []
        self.forget = Mock()
        self.stream = Stream(lambda *words: self.told.append(words), self.forget)

    @property
    def notices(self) -> list[str]:
        return [name for name, _ in self.told]

    def reason(self, seconds: float, frame: str = "map") -> Any:
        refusal = self.stream.follow(round(seconds * SECOND), frame)
        return None if refusal is None else refusal.reason


def test_stamps_out_of_order():
    heard = Heard()
    assert [heard.reason(s) for s in (5.0, 5.1, 5.1, 5.05, 5.2, 4.71)] == [
        None, None, "repeated_stamp", "late_frame", None, "late_frame",
    ]  # fmt: skip
    assert (heard.forget.call_count, heard.notices) == (0, [])
    # Half a second and more is a recording that starts over.
    assert heard.reason(4.7) is None
    assert (heard.forget.call_count, heard.notices) == (1, ["time_went_back"])
    assert heard.reason(4.7, "other") is None
    assert (heard.forget.call_count, heard.notices[1:]) == (2, ["map_changed"])
    heard.stream.reset()
    assert heard.reason(4.7, "other") is None


def test_a_stamp_of_zero_is_none_and_ends_no_track():
    heard = Heard()
    assert [heard.reason(s) for s in (5.0, 0.0, 5.1, 0.0, 5.1)] == [
        None, "no_stamp", None, "no_stamp", "repeated_stamp",
    ]  # fmt: skip
    assert (heard.forget.call_count, heard.notices) == (0, [])
    # Of a recording that starts at 0 it is a time like any other.
    heard = Heard()
    heard.stream.zero_is_time = True
    assert [heard.reason(s) for s in (0.0, 0.0, 0.1)] == [None, "repeated_stamp", None]
