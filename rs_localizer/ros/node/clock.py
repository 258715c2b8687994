# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Jumps of ROS time, told from the steps of a simulated clock."""

from collections.abc import Callable
from typing import Any

from rclpy.clock import ClockChange, JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node

# s; larger steps forward are jumps. A clock of 1 Hz that is played tenfold steps by 10, for which
# time tf2 remembers, too.
_LARGEST_STEP = 15


def watch_clock(node: Node, jumped: Callable[[float], None]) -> Any:
    """Call this with the seconds of each jump of the node's clock; return the handle.

    A simulated clock jumps where a simulation is reset, or another part of a recording is played;
    not with each of its steps, and not when it is set for the first time.
    """
    clock = node.get_clock()

    def step(change: Any) -> None:
        step_ns, same = change.delta.nanoseconds, ClockChange.ROS_TIME_NO_CHANGE
        # Else use_sim_time was set.
        if change.clock_change != same or clock.now().nanoseconds != step_ns:
            jumped(1e-9 * step_ns)

    jumps = JumpThreshold(
        min_forward=Duration(seconds=_LARGEST_STEP),
        min_backward=Duration(nanoseconds=-1),
        on_clock_change=True,
    )
    return clock.create_jump_callback(jumps, post_callback=step)
