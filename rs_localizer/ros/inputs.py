"""The subscriptions of a node."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

# As qos_profile_sensor_data: best effort, and room for the messages that come while the executor
# is busy elsewhere; the mailbox keeps the newest of them and counts the others.
SENSOR_DATA = {"depth": 5, "reliability": ReliabilityPolicy.BEST_EFFORT}


@dataclass(frozen=True, slots=True)
class Topic:
    """An input of a node."""

    type: type
    callback: Callable[[Any], None]  # runs in the executor's thread
    qos: Mapping[str, Any] = field(default_factory=lambda: SENSOR_DATA)


class Inputs:
    """Subscriptions that live while the node is active.

    Args:
        node: creates them.
        topics: by name. The executor goes through waiting messages in this order.
    """

    def __init__(self, node: Node, topics: Mapping[str, Topic]) -> None:
        self._node = node
        self._subscriptions = [
            node.create_subscription(
                topic.type,
                name,
                topic.callback,
                QoSProfile(**topic.qos),  # a new one each: overrides are written into it
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
            for name, topic in topics.items()
        ]

    @property
    def topics(self) -> list[str]:
        """Full names, after remapping."""
        return [subscription.topic_name for subscription in self._subscriptions]

    def close(self) -> None:
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
