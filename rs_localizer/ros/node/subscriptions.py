# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The subscriptions of a node."""

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    QoSCompatibility,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from rs_localizer.core.reasons import Notice
from rs_localizer.ros.node.conversion import steady_timer, type_name
from rs_localizer.ros.node.refusals import Refusals

Policies = tuple[ReliabilityPolicy, DurabilityPolicy]


def policies(profile: QoSProfile) -> Policies:
    return profile.reliability, profile.durability


def node_of(publisher: Any) -> str:
    """Return the full name of the node of a TopicEndpointInfo."""
    return f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"


def best(wished: Policies, offers: Sequence[Policies]) -> Policies:
    """Return the wished policies; for ``BEST_AVAILABLE`` the most that all publishers offer.

    If a subscription asks for more than a publisher offers, it gets nothing. If it asks for less,
    it loses large messages (of reliable clouds of 2 MB a best-effort subscription of Fast DDS got 3
    of 60) and misses latched ones. The middleware's own ``BEST_AVAILABLE`` looks at publishers only
    when a subscription is made.
    """
    reliability, durability = wished
    if reliability == ReliabilityPolicy.BEST_AVAILABLE:
        unanimous = offers and all(offer[0] == ReliabilityPolicy.RELIABLE for offer in offers)
        reliability = ReliabilityPolicy.RELIABLE if unanimous else ReliabilityPolicy.BEST_EFFORT
    if durability == DurabilityPolicy.BEST_AVAILABLE:
        unanimous = offers and all(offer[1] == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
        durability = DurabilityPolicy.TRANSIENT_LOCAL if unanimous else DurabilityPolicy.VOLATILE
    return reliability, durability


# The profile is qos_profile_sensor_data, but reliable if the publishers are, and deeper. Messages
# that come while this process does not get the CPU must not be lost unseen: the worker keeps the
# newest one and counts the others.
SENSOR_DATA = {"depth": 20, "reliability": ReliabilityPolicy.BEST_AVAILABLE}
# Messages that come some hundred times a second.
FAST_DATA = SENSOR_DATA | {"depth": 200}
# Also what was published before we came.
LATCHED = {
    "depth": 1,
    "reliability": ReliabilityPolicy.BEST_AVAILABLE,
    "durability": DurabilityPolicy.BEST_AVAILABLE,
}

# rclpy's default policies, and whether latched messages are wanted.
_OVERRIDABLE = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)

# A topic without a message for so long (s) is silent.
_LONG = 2.0
# Interval (s) at which the publishers are looked at.
_LOOK_PERIOD = 0.5


# DDS loses best-effort messages in many packets before any subscriber sees them: of images of
# 500 kB, 614 kB and 922 kB 20, 4 and 2 of 20 came, with Ubuntu's socket buffers.
_LARGE = (
    ": best-effort messages above half a megabyte are lost in the network stack; have them "
    "published reliably or as image/compressed, or raise net.core.rmem_max"
)
_LARGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2")


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic that a node listens to."""

    type: type
    callback: Callable[[Any], None]  # runs in the executor's thread
    qos: Mapping[str, Any] = field(default_factory=lambda: SENSOR_DATA)
    lasting: bool = False  # one message is enough
    overridable: bool = False  # whether its QoS has parameters
    single: bool = False  # whether two publishers would contradict each other


@dataclass(frozen=True, slots=True)
class Silence:
    """Silence of a topic, and its cause."""

    topic: str  # full name
    seconds: float  # since the last message, or since the subscription was made
    heard: bool  # whether there was a message
    cause: str  # why there is none, if it has been silent for long
    mismatch: bool  # there are publishers, and none of them can be heard
    reliable: bool = False  # whether what is lost on the way is sent again


class Inputs:
    """Subscriptions that live while the node is active.

    Args:
        node: creates them.
        topics: by name.
        refusals: told of publishers that cannot be heard.
    """

    def __init__(self, node: Node, topics: Mapping[str, Topic], refusals: Refusals) -> None:
        self._node, self._topics, self._refusals = node, topics, refusals
        self._created = time.monotonic()
        self._heard: dict[str, float] = {}
        self._wished: dict[str, Policies] = {}  # with overrides
        self._subscriptions: dict[str, Subscription] = {}
        self._timer = steady_timer(node, _LOOK_PERIOD, self._follow_publishers)
        try:
            for name in topics:
                self._subscriptions[name] = self._subscribe(name)
        except Exception:
            self.close()
            raise

    @property
    def topics(self) -> list[str]:
        """Full names, after remapping."""
        return [subscription.topic_name for subscription in self._subscriptions.values()]

    def silence(self) -> dict[str, Silence]:
        """Return silences of the topics, by the names that the node gave them."""
        return {name: self._silence(name) for name in self._subscriptions}

    def close(self) -> None:
        """Take no more messages."""
        self._node.destroy_timer(self._timer)
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions = {}

    def _follow_publishers(self) -> None:
        """Listen anew to topics whose publishers offer more, or less, than they are heard with."""
        for name, subscription in self._subscriptions.items():
            publishers = self._node.get_publishers_info_by_topic(subscription.topic_name)
            if self._topics[name].single and len(publishers) > 1:
                names = " and ".join(sorted(map(node_of, publishers)))
                text = f"{names} publish on {subscription.topic_name}: their frames alternate"
                self._refusals.notice(Notice.TWO_PUBLISHERS, text, name)
            offers = [policies(each.qos_profile) for each in publishers]
            if offers and best(self._wished[name], offers) != policies(subscription.qos_profile):
                self._node.destroy_subscription(subscription)
                self._subscriptions[name] = self._subscribe(name)

    def _subscribe(self, name: str) -> Subscription:
        topic = self._topics[name]

        def take(message: Any) -> None:
            self._heard[name] = time.monotonic()
            topic.callback(message)

        profile, options = QoSProfile(**topic.qos), None
        settle = functools.partial(self._settle, name)
        if topic.overridable:  # called once the user's values are written into the profile
            options = QoSOverridingOptions(_OVERRIDABLE, callback=settle)
        else:
            settle(profile)
        return self._node.create_subscription(
            topic.type,
            name,
            take,
            profile,
            # The graph knows more than events do, and an event that is pending when its
            # subscription is destroyed ends the process (ros2/rclpy#1644).
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            qos_overriding_options=options,
        )

    def _settle(self, name: str, profile: QoSProfile) -> SetParametersResult:
        """Fill in, after the user's overrides, what the publishers offer now."""
        self._wished[name] = policies(profile)
        found = self._node.get_publishers_info_by_topic(self._node.resolve_topic_name(name))
        offers = [policies(each.qos_profile) for each in found]
        profile.reliability, profile.durability = best(self._wished[name], offers)
        return SetParametersResult(successful=True)

    def _silence(self, name: str) -> Silence:
        topic = self._subscriptions[name].topic_name
        heard = self._heard.get(name)
        seconds = time.monotonic() - (self._created if heard is None else heard)
        cause, mismatch = "", False
        if seconds > _LONG and not (heard is not None and self._topics[name].lasting):
            cause, mismatch = self._cause(self._subscriptions[name])
        if mismatch:
            self._refusals.notice(
                Notice.INCOMPATIBLE_PUBLISHER, f"no message arrives on {topic}: {cause}", topic
            )
        reliability, _ = policies(self._subscriptions[name].qos_profile)
        reliable = reliability == ReliabilityPolicy.RELIABLE
        return Silence(topic, seconds, heard is not None, cause, mismatch, reliable)

    def _cause(self, subscription: Subscription) -> tuple[str, bool]:
        """Return why nothing is heard, and whether the cause is the QoS or the type."""
        wanted = type_name(subscription.msg_type)
        unfit = []
        publishers = self._node.get_publishers_info_by_topic(subscription.topic_name)
        for publisher in publishers:
            where = node_of(publisher)
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
        text = f"it has {count} publisher{'s' if count > 1 else ''}, but no message comes"
        unreliable = subscription.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        return text + (_LARGE if unreliable and wanted in _LARGE_TYPES else ""), False
