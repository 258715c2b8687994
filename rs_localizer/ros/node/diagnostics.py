"""Publishes how the node is, as diagnostic_updater does (which has no wheel on PyPI)."""

from __future__ import annotations

from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from rs_localizer.io.topics import DIAGNOSTICS
from rs_localizer.ros.node.health import Health, Level, State

_PERIOD = 1.0  # s
# The same state for so many periods is worth a line in the log.
_WORTH_A_LINE = 5
_RARELY = 128


class Diagnostics:
    """A status ``NODE: TASK`` on ``/diagnostics``, once a second and whatever ROS time does.

    Args:
        node: publishes it.
        examine: the health, and the camera's frame (the hardware_id; empty if unknown).
        notice: told of a state that lasts and is not right, by its name and one sentence.
        task: what the node does.
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
        # As diagnostic_updater in C++: with the namespace and without the first slash.
        self._name = f"{node.get_fully_qualified_name().lstrip('/')}: {task}"
        self._publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS, 1)
        self._timer = node.create_timer(
            _PERIOD, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def publish(self) -> Health:
        """Publish the health now."""
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
        return health

    def _tick(self) -> None:
        health = self.publish()
        state = health.level, health.state
        self._periods = self._periods + 1 if state == self._state else 1
        self._state = state
        if health.level != Level.OK and health.state is not State.INACTIVE and self._worth_a_line():
            lacking = health.state in (State.WAITING, State.LOST)
            self._notice(self._lack if lacking else health.state, health.message)

    def _worth_a_line(self) -> bool:
        """After 5, 10, 20, 40, ... periods in the same state, then every ten minutes."""
        times, rest = divmod(self._periods, _WORTH_A_LINE)
        if rest:
            return False
        return times.bit_count() == 1 if times < _RARELY else times % _RARELY == 0
