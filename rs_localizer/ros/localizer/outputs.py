"""The publishers of a localized frame."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from rs_localizer.io.outputs import TYPES, Localized, each_message
from rs_localizer.ros.node.conversion import make_message, message_class

_QOS = {"depth": 10, "reliability": ReliabilityPolicy.RELIABLE}


class Outputs:
    """Publishes frames on the topics of :data:`rs_localizer.io.outputs.TYPES`.

    Args:
        node: creates the publishers, which publish while it is active.
        afterwards: called with each frame after its messages (to broadcast transforms).
    """

    def __init__(
        self, node: LifecycleNode, afterwards: Callable[[Localized], None] | None = None
    ) -> None:
        self._node = node
        self._afterwards = afterwards
        self._publishers = {
            name: node.create_lifecycle_publisher(
                message_class(type_name),
                f"~/{name}",
                QoSProfile(**_QOS),  # a new one each: overrides are written into it
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
            for name, type_name in TYPES.items()
        }

    def publish(self, frame: Localized) -> None:
        """Publish what somebody listens to; nothing else is built."""
        wanted = [
            name
            for name, publisher in self._publishers.items()
            if publisher.get_subscription_count()
        ]
        for name, message in each_message(frame, make_message, wanted):
            self._publishers[name].publish(message)
        if self._afterwards is not None:
            self._afterwards(frame)

    def close(self) -> None:
        for publisher in self._publishers.values():
            self._node.destroy_lifecycle_publisher(publisher)
        self._publishers = {}
