# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The heartbeat by which nav2's lifecycle manager sees that a node it has activated lives.

The manager expects a status with the node's name on ``bond``, at least once in its ``bond_timeout``
(4 s), and otherwise stops the robot. The messages come from the package ``bond``, which comes with
nav2 and is not on PyPI. So it is imported when a node is activated.
"""

import uuid

from rclpy.node import Node

from rs_localizer.ros.node.conversion import message_class, steady_timer

_TYPE, _TOPIC = "bond/msg/Status", "bond"
# Period and timeout (s) of nav2's own servers.
_PERIOD, _TIMEOUT = 0.1, 4.0
# Queue depth of bondcpp's publishers.
_DEPTH = 5


class Bond:
    """Beats while somebody listens, until it is closed.

    Args:
        node: the one that is watched.

    Raises:
        ImportError: without the package ``bond``.
    """

    def __init__(self, node: Node) -> None:
        self._status = message_class(_TYPE)
        self._node = node
        self._instance = str(uuid.uuid4())
        self._publisher = node.create_publisher(self._status, _TOPIC, _DEPTH)
        self._timer = steady_timer(node, _PERIOD, self._beat)

    def _beat(self, *, active: bool = True) -> None:
        if not (self._node.context.ok() and self._publisher.get_subscription_count()):
            return
        status = self._status(
            id=self._node.get_name(),
            instance_id=self._instance,
            active=active,
            heartbeat_timeout=_TIMEOUT,
            heartbeat_period=_PERIOD,
        )
        status.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(status)

    def close(self) -> None:
        """End it as one who leaves: the manager need not wait for the timeout."""
        self._beat(active=False)
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)
