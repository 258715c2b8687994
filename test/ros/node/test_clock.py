# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Jumps of ROS time, as a node hears them."""

import pytest
import rclpy
from rclpy.clock import ClockType
from rclpy.parameter import Parameter
from rclpy.time import Time

from rs_localizer.ros.node.clock import watch_clock


def test_a_node_hears_jumps_and_no_steps(peer):
    simulated = [Parameter("use_sim_time", value=True)]
    node = rclpy.create_node("simulated", context=peer.node.context, parameter_overrides=simulated)
    told: list[float] = []
    handle = watch_clock(node, told.append)

    def set_to(seconds: float) -> None:
        stamp = Time(nanoseconds=round(1e9 * seconds), clock_type=ClockType.ROS_TIME)
        node.get_clock().set_ros_time_override(stamp)

    for tick in range(20):  # the first one sets it
        set_to(1e9 + 0.1 * tick)
    assert told == []
    set_to(3.0)
    assert told.pop() == pytest.approx(-1e9 + 1.1)
    for tick in range(20):  # played tenfold
        set_to(5.0 + 1.0 * tick)
    assert told == []
    set_to(60.0)
    set_to(60.1)
    assert told == pytest.approx([36.0])
    set_to(20.0)
    assert told[1:] == pytest.approx([-40.1])
    node.set_parameters([Parameter("use_sim_time", value=False)])
    assert len(told) == 3
    handle.unregister()
    node.destroy_node()
