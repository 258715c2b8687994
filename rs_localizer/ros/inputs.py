"""The subscriptions of a node."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
    qos_policy_name_from_kind,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from rs_localizer.ros.conversion import type_name

# As qos_profile_sensor_data: best effort, and room for the messages that come while the executor
# is busy elsewhere; the mailbox keeps the newest of them and counts the others.
SENSOR_DATA = {"depth": 5, "reliability": ReliabilityPolicy.BEST_EFFORT}

# A topic without a message for so long (s) is silent.
_LONG = 2.0


@dataclass(frozen=True, slots=True)
class Topic:
    """An input of a node."""

    type: type
    callback: Callable[[Any], None]  # runs in the executor's thread
    qos: Mapping[str, Any] = field(default_factory=lambda: SENSOR_DATA)


@dataclass(frozen=True, slots=True)
class Silence:
    """Whether messages come on a topic, and why not."""

    topic: str  # full name
    seconds: float  # since the last message, or since the subscription was made
    heard: bool  # whether there was a message
    cause: str  # why there is none, if it has been silent for long
    mismatch: bool  # there are publishers, and none of them can be heard


class Inputs:
    """Subscriptions that live while the node is active.

    Args:
        node: creates them.
        topics: by name. The executor goes through waiting messages in this order.
        notice: told of publishers that cannot be heard, by a name and one sentence.
    """

    def __init__(
        self, node: Node, topics: Mapping[str, Topic], notice: Callable[[str, str], None]
    ) -> None:
        self._node = node
        self._notice = notice
        self._created = time.monotonic()
        self._heard: dict[str, float] = {}
        self._subscriptions = {name: self._subscribe(name, topic) for name, topic in topics.items()}

    @property
    def topics(self) -> list[str]:
        """Full names, after remapping."""
        return [subscription.topic_name for subscription in self._subscriptions.values()]

    def silence(self) -> dict[str, Silence]:
        """How it stands with each topic, by the name that the node gave it."""
        return {name: self._silence(name) for name in self._subscriptions}

    def close(self) -> None:
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions = {}

    def _subscribe(self, name: str, topic: Topic) -> Subscription:
        def take(message: Any) -> None:
            self._heard[name] = time.monotonic()
            topic.callback(message)

        def incompatible(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind)
            full = self._node.resolve_topic_name(name)
            self._notice(
                "incompatible_qos",
                f"a publisher of {full} offers another {policy} than this node asks for, and "
                "cannot be heard",
            )

        return self._node.create_subscription(
            topic.type,
            name,
            take,
            QoSProfile(**topic.qos),  # a new one each: overrides are written into it
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=incompatible),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def _silence(self, name: str) -> Silence:
        topic = self._subscriptions[name].topic_name
        heard = self._heard.get(name)
        seconds = time.monotonic() - (self._created if heard is None else heard)
        cause, mismatch = "", False
        if seconds > _LONG:
            cause, mismatch = self._cause(self._subscriptions[name])
        return Silence(topic, seconds, heard is not None, cause, mismatch)

    def _cause(self, subscription: Subscription) -> tuple[str, bool]:
        """Why nothing is heard, and whether that is because of the QoS or the type."""
        wanted = type_name(subscription.msg_type)
        unfit = []
        publishers = self._node.get_publishers_info_by_topic(subscription.topic_name)
        for publisher in publishers:
            where = f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"
            if publisher.topic_type != wanted:
                unfit.append(f"{where} publishes {publisher.topic_type}, not {wanted}")
                continue
            fit, reason = qos_check_compatible(publisher.qos_profile, subscription.qos_profile)
            if fit == QoSCompatibility.ERROR:
                text = " ".join(reason.split()).removeprefix("ERROR: ").rstrip(";. ")
                unfit.append(f"the QoS of {where} does not fit: {text}")
        if not publishers:
            return "it has no publisher", False
        if len(unfit) == len(publishers):
            return "; ".join(unfit), True
        count = len(publishers)
        return f"it has {count} publisher{'s' if count > 1 else ''}, but no message comes", False
