# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Jumps of ROS time, told from the steps of a simulated clock."""

from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.clock import ClockChange, JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node

_SAME_CLOCK = ClockChange.ROS_TIME_NO_CHANGE  # else use_sim_time was set
# A step of a simulation or a recording that is played is none, however fast it is played: s, and
# periods of the clock.
_LEAST, _PERIODS = 5.0, 20.0
_REMEMBERED = 9  # steps, of which the median is the period


class ClockJumps:
    """Tells jumps from steps."""

    def __init__(self) -> None:
        self._steps: deque[int] = deque(maxlen=_REMEMBERED)

    def is_jump(self, before_ns: int, step_ns: int) -> bool:
        """Return True if a step of the clock makes all earlier knowledge useless.

        Args:
            before_ns: the clock before this step; 0: it has not been set.
            step_ns: by how much it has changed.
        """
        if before_ns == 0:
            return False
        if step_ns < 0:
            self._steps.clear()
            return True
        steps = sorted(self._steps)
        period = steps[len(steps) // 2] if steps else step_ns
        jump = step_ns > max(1e9 * _LEAST, _PERIODS * period)
        if not jump:
            self._steps.append(step_ns)
        return jump


def watch_clock(node: Node, jumped: Callable[[float], None]) -> Any:
    """Call this with the seconds of each jump of the node's clock; return the handle.

    A simulated clock jumps where a simulation is reset, or another part of a recording is played;
    not with each of its steps, and not when it is set for the first time.
    """
    clock, jumps = node.get_clock(), ClockJumps()

    def step(change: Any) -> None:
        step_ns, other = change.delta.nanoseconds, change.clock_change != _SAME_CLOCK
        if other or jumps.is_jump(clock.now().nanoseconds - step_ns, step_ns):
            jumped(1e-9 * step_ns)

    every = JumpThreshold(
        min_forward=Duration(nanoseconds=1),
        min_backward=Duration(nanoseconds=-1),
        on_clock_change=True,
    )
    return clock.create_jump_callback(every, post_callback=step)
