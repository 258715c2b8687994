# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A state that lasts is worth a line in the log, ever more seldom."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType

from rs_localizer.ros.node.diagnostics import Diagnostics, Health, Level, State
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.statistics import missing


class Bench:
    """Diagnostics without a graph, whose timer is turned by hand."""

    def __init__(self) -> None:
        self.health = Health(Level.OK, State.TRACKING, "all is well", {"State": "tracking"})
        self.lines: list[str] = []
        self.published: list[DiagnosticArray] = []
        node: Any = SimpleNamespace(
            get_fully_qualified_name=lambda: "/front/rs_localizer",
            create_publisher=lambda *_: SimpleNamespace(publish=self.published.append),
            create_timer=self._create_timer,
            get_clock=Clock,
        )
        self.clock: Any = None
        Diagnostics(
            node,
            lambda: (self.health, "camera"),
            lambda *texts: self.lines.append(": ".join(texts)),
            "localizer",
            "no_pose",
        )

    def _create_timer(self, period: float, callback: Any, clock: Any) -> None:
        assert period == 1.0
        self.tick, self.clock = callback, clock


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_the_message(bench):
    bench.tick()
    (status,) = bench.published[0].status
    assert status.name == "front/rs_localizer: localizer"
    assert (status.level, status.message, status.hardware_id) == (b"\0", "all is well", "camera")
    assert [(item.key, item.value) for item in status.values] == [("State", "tracking")]
    # ROS time may stand still.
    assert bench.clock.clock_type == ClockType.STEADY_TIME


@pytest.mark.parametrize(
    ("level", "state", "name"),
    [
        (Level.STALE, State.WAITING, "no_pose"),
        (Level.ERROR, "lost", "no_pose"),
        (Level.WARN, State.TRACKING, "tracking"),
    ],
)
def test_lines_of_a_lasting_state(bench, level, state, name):
    bench.health = Health(level, state, "something is wrong", {})
    when = []
    for second in range(1, 2000):
        before = len(bench.lines)
        bench.tick()
        if len(bench.lines) > before:
            when.append(second)
    assert when == [5, 10, 20, 40, 80, 160, 320, 640, 1280, 1920]
    assert set(bench.lines) == {f"{name}: something is wrong"}


@pytest.mark.parametrize(
    ("rate", "jitter", "share", "seeds"),
    [
        *((*each, 0.02, share, 1) for *each, share in
          ((10.0, 0.6), (10.0, 0.9), (30.0, 0.3), (30.0, 0.9), (60.0, 0.2))),
        # A steady camera misses nothing.
        *((rate, jitter, 1.0, 20) for rate in (10.0, 30.0, 60.0) for jitter in (0.0, 0.02, 0.05)),
    ],
)  # fmt: skip
def test_what_was_dropped_is_counted(rate, jitter, share, seeds):
    """Jitter as a part of the period."""
    for seed in range(seeds):
        rng, count = np.random.default_rng(seed), round(5 * rate)
        sent = (np.arange(count) + rng.normal(0.0, jitter, count)) * 1e9 / rate
        keep = rng.random(count) < share
        keep[[0, -1]] = True
        assert missing(sent[keep].astype(np.int64)) == count - keep.sum()


def test_a_clock_that_is_set_loses_nothing():
    sent = np.arange(30) * 33_333_333
    sent[15:] += 3_600_000_000_000
    assert missing(sent) == 0


def test_a_reason_is_logged_once_in_five_seconds_and_always_counted():
    lines, now = [], [100.0]
    refusals = Refusals(lines.append, clock=lambda: now[0])
    for second in range(12):
        now[0] = 100.0 + second
        refusals.add("odd", f"field {second}")
        refusals.notice("other", "no refusal")
    more = " (4 more since the last report)"
    assert [line for line in lines if "odd" in line] == [
        "odd: field 0", f"odd: field 5{more}", f"odd: field 10{more}"
    ]  # fmt: skip
    assert refusals.counts == {"odd": 12}
    assert refusals.recent({"odd", "other", "never"}, 1.0) == {
        "odd": "field 11", "other": "no refusal"
    }  # fmt: skip
