# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""rclpy messages, made by type name or copied from a recording's, their publishers, timers."""

import array
import importlib
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.timer import Timer

_OUTPUT = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


@cache
def message_class(type_name: str) -> Any:
    """Return the rclpy class of a type such as ``geometry_msgs/msg/Pose``."""
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def installed(*type_names: str) -> Any:
    """Return the rclpy class of the first of these types that is installed, or None."""
    for name in type_names:
        try:
            return message_class(name)
        except ImportError:
            continue
    return None


def type_name(message_type: Any) -> str:
    """Return the name of an rclpy class, such as ``geometry_msgs/msg/Pose``."""
    return f"{message_type.__module__.split('.')[0]}/msg/{message_type.__name__}"


def make_message(type_name: str, **fields: Any) -> Any:
    """Make an rclpy message (see :data:`rs_localizer.io.messages.Make`)."""
    for name, value in fields.items():
        if isinstance(value, np.ndarray) and value.dtype == np.uint8:
            # rclpy checks every single element of any other container.
            fields[name] = array.array("B", value.tobytes())
    return message_class(type_name)(**fields)


def copy_message(source: Any, type_name: str) -> Any:
    """Make the rclpy message of this type with the values of a message of rosbags."""
    from rs_localizer.io.bags import typestore  # recordings, which the nodes never read

    return deserialize_message(
        bytes(typestore().serialize_cdr(source, type_name)), message_class(type_name)
    )


def create_output(node: Any, kind: type, topic: str, *, overridable: bool = False) -> Any:
    """Create a reliable publisher of an active :class:`.ManagedNode`, until it is cleaned up.

    Its QoS may have parameters.
    """
    options = QoSOverridingOptions.with_default_policies() if overridable else None
    made = node.create_lifecycle_publisher(kind, topic, _OUTPUT, qos_overriding_options=options)
    node.opened.callback(node.destroy_lifecycle_publisher, made)
    return made


def steady_timer(node: Node, period: float, callback: Callable[[], None]) -> Timer:
    """Create a timer (s) that goes on whatever ROS time does."""
    return node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))
