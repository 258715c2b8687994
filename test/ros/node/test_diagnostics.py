# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A state that lasts is worth a line in the log, ever more seldom."""

from types import SimpleNamespace
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType

from rs_localizer.ros.node.health import Diagnostics, Health, Level, State


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


def test_another_state_is_told_afresh(bench):
    for state in (State.LOST, State.WAITING):
        bench.health = Health(Level.ERROR, state, f"because {state}", {})
        for _ in range(7):
            bench.tick()
    assert bench.lines == ["no_pose: because lost", "no_pose: because waiting for"]


@pytest.mark.parametrize(("level", "state"), [(Level.OK, "tracking"), (Level.OK, "inactive")])
def test_what_is_meant_so_is_not_logged(bench, level, state):
    bench.health = Health(level, state, "as it should be", {})
    for _ in range(20):
        bench.tick()
    assert bench.lines == []
