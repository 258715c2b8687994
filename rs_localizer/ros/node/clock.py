# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Jumps of ROS time."""

from collections.abc import Callable
from typing import Any

from rclpy.clock import ClockChange, JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node

from rs_localizer.pipeline.clock_jumps import ClockJumps

_SAME_CLOCK = ClockChange.ROS_TIME_NO_CHANGE  # else use_sim_time was set


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
