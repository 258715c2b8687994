# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamps out of order, and poses that no camera can have."""

from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from rs_localizer.config import NodeConfig
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

    def pace(self, time_ns: int, estimate: Any, points: Any) -> bool:
        return self.stream.pace(time_ns, estimate, points, NodeConfig(), lambda: estimate)

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


@pytest.mark.parametrize(
    ("unit", "depth", "speed", "noise", "to_and_fro", "told"),
    [
        (1000.0, 2.0, 0.2, 0.01, True, "millimetres"),
        (1000.0, 2.0, 0.2, 0.01, False, "millimetres"),
        (100.0, 4.0, 0.4, 0.01, True, "centimetres"),
        (1000.0, 2.0, 0.0, 0.01, False, ""),
        (1.0, 100.0, 40.0, 0.1, False, ""),  # a car
        (1.0, 50.0, 4.0, 0.1, True, ""),  # a drone, 40 m/s^2
        (1.0, 100.0, 0.0, 30.0, False, ""),
    ],
)
def test_the_unit_of_a_map_is_named(unit, depth, speed, noise, to_and_fro, told):
    rng = np.random.default_rng(0)
    heard = Heard()
    for i in range(90):
        # A hand at 1 Hz is after a second where it was: its mean speed is the same.
        way = speed * np.sin(2.0 * np.pi * i / 30.0) / 4.0 if to_and_fro else speed * i / 30.0
        place = np.array([way, 0.0, 2.0]) + rng.normal(0.0, noise, 3)
        covariance = np.diag(np.full(12, (unit * noise) ** 2))
        estimate: Any = SimpleNamespace(
            position=unit * place, rotation=np.eye(3), covariance=covariance, inliers=[0, 1, 2]
        )
        points = estimate.position + unit * depth * np.eye(3)[[2, 2, 2]]
        odd = heard.pace(i * SECOND // 30, estimate, points)
    assert (odd, "map_scale" in heard.notices) == (bool(told), bool(told))
    for _, text in heard.told:
        assert f"{unit * depth:.0f} m from the points: is the map in {told}?" in text
        assert f"by a factor of {1.0 / unit:g} (map align --scale)" in text
    if told:
        speeds = [float(text.split(" m/s")[0].split()[-1]) for _, text in heard.told]
        assert np.median(speeds) == pytest.approx(unit * speed, rel=0.25)


def test_what_happened_while_nothing_was_seen_is_no_speed():
    """A robot that was carried elsewhere, or a map that was exchanged."""
    heard, covariance = Heard(), np.diag(np.full(12, 1e-4))
    for i in range(6):
        estimate: Any = SimpleNamespace(
            position=np.full(3, 1e3 * i),
            rotation=np.eye(3),
            covariance=covariance,
            inliers=[0, 1, 2],
        )
        points = estimate.position + 100.0 * np.eye(3)[[2, 2, 2]]
        heard.pace(round(0.6 * i * SECOND), estimate, points)
    assert heard.notices == []
