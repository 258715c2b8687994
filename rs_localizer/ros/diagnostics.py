"""Publishes how the node is, as diagnostic_updater does (which has no wheel on PyPI)."""

from __future__ import annotations

from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from rs_localizer.ros.health import Health, Level

_PERIOD = 1.0  # s
# The same state for so many periods is worth a line in the log.
_WORTH_A_LINE = 5


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
        task: str = "localizer",
        lack: str = "no_pose",
    ) -> None:
        self._node = node
        self._examine = examine
        self._notice = notice
        self._lack = lack
        self._state, self._periods = "", 0
        # As diagnostic_updater in C++: with the namespace and without the first slash.
        self._name = f"{node.get_fully_qualified_name().lstrip('/')}: {task}"
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 1)
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
        self._periods = self._periods + 1 if health.state == self._state else 1
        self._state = health.state
        # What is wrong with single frames has been logged with each of them.
        waiting = health.state.startswith("waiting for") and health.level != Level.OK
        if waiting and self._periods % _WORTH_A_LINE == 0:
            self._notice(self._lack, health.message)
