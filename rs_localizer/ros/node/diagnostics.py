# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of a node: a level, a state, one sentence, and numbers by readable names."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum, StrEnum

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from rs_localizer.io.topics import DIAGNOSTICS
from rs_localizer.ros.node.conversion import steady_timer
from rs_localizer.ros.node.statistics import WINDOW, Event, Summary

SOME = 0.05
"""Share of the messages that may be refused, replaced or lost before it is worth a warning."""


class State(StrEnum):
    """THE list of states of nodes; docs/reasons.md says what each means and what to do."""

    INACTIVE = "inactive"
    WAITING = "waiting for"  # what, is the subject
    # States of the localizer.
    BUSY = "busy"
    LOST = "lost"
    LOCALIZED = "localized"
    TRACKING = "tracking"
    # States of nodes that look at images.
    IDLE = "idle"
    DETECTING = "detecting"


# Advice for a node that is not active, by the label of its state.
_STEPS = {"unconfigured": "configure and activate it", "finalized": "start it again"}


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class Health:
    """A diagnosis."""

    level: Level
    state: State
    message: str  # one sentence
    values: dict[str, str] = field(default_factory=dict)  # by readable names
    subject: str = ""  # of the state

    def with_values(self, values: dict[str, str]) -> "Health":
        """Return the status with ``values`` appended after its state and subject."""
        return replace(self, values={"State": f"{self.state} {self.subject}".strip()} | values)


def out_of_service(life_cycle: str) -> Health | None:
    """Return the health of a node that is not active, by the label of its state, or None."""
    if life_cycle == "active":
        return None
    # Somebody wants it so: no fault, which an aggregator would make of STALE.
    steps = _STEPS.get(life_cycle, "activate it")
    return Health(Level.OK, State.INACTIVE, f"the node is {life_cycle}: {steps}")


def one_line(oddities: Mapping[str, str]) -> str:
    """Join oddities into one line."""
    return "; ".join(f"{name}: {text}" for name, text in oddities.items())


def hindrance(summary: Summary, what: str) -> str:
    """Say why some of the last messages have no result; empty if nearly all have one."""
    lately, lost = summary.lately, summary.recently_missing
    came = lately.get(Event.RECEIVED, 0)
    for event, text in ((Event.REFUSED, "were refused"), (Event.REPLACED, "came too fast")):
        if (bad := lately.get(event, 0)) > SOME * came:
            return f"{bad} {what} {text} in the last {WINDOW:.0f} s"
    if lost > SOME * came:
        return (
            f"messages are lost: by their stamps, {lost} of {came + lost} have not come in the "
            f"last {WINDOW:.0f} s (is the publisher best effort, "
            "does it pause, or is the machine too slow?)"
        )
    return ""


def counts(summary: Summary, what: str, done: str) -> dict[str, str]:
    """Return rates, latency and totals as values, without what is zero and rare."""
    values = {
        f"{what} in (Hz)": f"{summary.rate_in:.1f}",
        f"{done} (Hz)": f"{summary.rate_out:.1f}",
    }
    for name, value in (("Latency", summary.latency), ("Delay of the stamp", summary.delay)):
        if value is not None:
            values[f"{name} p50 (ms)"], values[f"{name} p95 (ms)"] = (
                f"{1e3 * seconds:.2f}" for seconds in value
            )
    for event in Event:
        count = summary.total.get(event, 0)
        if count or event is not Event.DROPPED:
            values[f"{what} {event}"] = str(count)
    if summary.recently_missing:
        values[f"{what} missing by their stamps, recently"] = str(summary.recently_missing)
    values |= {f"Refused: {reason}": str(n) for reason, n in sorted(summary.reasons.items())}
    return values | ({} if summary.last is None else summary.last.values)


_PERIOD = 1.0  # s
# The same state for this many periods is worth a line in the log.
_WORTH_A_LINE = 5
_RARELY = 128


class Diagnostics:
    """A status ``NODE: TASK`` on ``/diagnostics``, once a second and whatever ROS time does.

    Args:
        node: publishes it.
        examine: the health, and the camera's frame (the hardware_id; empty if unknown).
        notice: told of a state that lasts and is not right, by its name and one sentence.
        task: name of the node's task.
        lack: name of the notice.
    """

    def __init__(
        self,
        node: Node,
        examine: Callable[[], tuple[Health, str]],
        notice: Callable[[str, str], None],
        task: str,
        lack: str,
    ) -> None:
        self._node = node
        self._examine = examine
        self._notice = notice
        self._lack = lack
        self._state: tuple[Level, State] | None = None
        self._periods = 0
        # The name is built as by diagnostic_updater in C++, with the namespace and without the
        # first slash.
        self._name = f"{node.get_fully_qualified_name().lstrip('/')}: {task}"
        self._publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS, 1)
        self._timer = steady_timer(node, _PERIOD, self._tick)

    def _tick(self) -> None:
        health, camera_frame = self._examine()
        status = DiagnosticStatus(
            level=bytes([health.level]),
            name=self._name,
            message=health.message,
            hardware_id=camera_frame or "none",
            values=[KeyValue(key=key, value=value) for key, value in health.values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)
        state = health.level, health.state
        self._periods = self._periods + 1 if state == self._state else 1
        self._state = state
        if health.level != Level.OK and health.state is not State.INACTIVE and self._worth_a_line():
            lacking = health.state in (State.WAITING, State.LOST)
            self._notice(self._lack if lacking else health.state, health.message)

    def _worth_a_line(self) -> bool:
        """Return True after 5, 10, 20 ... periods in a state, then every ten minutes."""
        times, rest = divmod(self._periods, _WORTH_A_LINE)
        if rest:
            return False
        return times.bit_count() == 1 if times < _RARELY else times % _RARELY == 0
