# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The output for PX4, ``~/vehicle_odometry``: asked for by ``px4_odometry``, needs px4_msgs."""

from __future__ import annotations

from rclpy.lifecycle import LifecycleNode

from rs_localizer.config import NodeConfig, Px4Odometry
from rs_localizer.io.outputs import Localized
from rs_localizer.io.topics import VEHICLE_ODOMETRY
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.px4 import TYPE, Jumps, vehicle_odometry
from rs_localizer.ros.node.conversion import create_output, make_message, message_class


def check(config: NodeConfig) -> None:
    """Raise ``ValueError`` if the output is asked for and px4_msgs is not installed."""
    if config.px4_odometry == Px4Odometry.NONE:
        return
    try:
        message_class(TYPE)
    except ImportError as error:
        raise ValueError(
            f"px4_odometry {config.px4_odometry} needs the package px4_msgs, which cannot be "
            f"imported ({error}): build it in your workspace, of PX4's release"
        ) from error


class Px4Output:
    """Publishes frames as PX4's messages.

    Args:
        node: creates the publisher, and has the clock of the stamps.
        frames: has the settings that hold now.
    """

    def __init__(self, node: LifecycleNode, frames: FrameLocalizer) -> None:
        self._node = node
        self._world = frames.config.px4_odometry
        self._jumps = Jumps(lambda: frames.config)
        self._publisher = create_output(node, message_class(TYPE), f"~/{VEHICLE_ODOMETRY}")

    def publish(self, frame: Localized) -> None:
        """Publish a frame; jumps are counted whether anybody listens or not."""
        resets = self._jumps.add(frame)
        if self._publisher.get_subscription_count():
            now_ns = self._node.get_clock().now().nanoseconds
            fields = vehicle_odometry(frame, self._world, resets, now_ns)
            self._publisher.publish(make_message(TYPE, **fields))

    def close(self) -> None:
        self._node.destroy_lifecycle_publisher(self._publisher)
