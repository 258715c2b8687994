"""With which quality of service a topic is heard: the best that its publishers offer.

A subscription that asks for more than a publisher offers hears nothing; one that asks for less
loses what is large (of clouds of 2 MB, sent reliably, a best-effort subscription of Fast DDS heard
3 of 60) and misses what was latched before it came. ``BEST_AVAILABLE`` of the middleware looks at
the publishers when a subscription is made, and not at those that come later: so we do, by and by.
"""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

Policies = tuple[ReliabilityPolicy, DurabilityPolicy]


def policies(profile: QoSProfile) -> Policies:
    return profile.reliability, profile.durability


def offered(node: Node, topic: str) -> list[Policies]:
    """By the publishers of a topic (full name)."""
    return [policies(info.qos_profile) for info in node.get_publishers_info_by_topic(topic)]


def best(wished: Policies, offers: Sequence[Policies]) -> Policies:
    """What is wished, and where that is ``BEST_AVAILABLE``, the most that all of them offer."""
    reliability, durability = wished
    if reliability == ReliabilityPolicy.BEST_AVAILABLE:
        unanimous = offers and all(offer[0] == ReliabilityPolicy.RELIABLE for offer in offers)
        reliability = ReliabilityPolicy.RELIABLE if unanimous else ReliabilityPolicy.BEST_EFFORT
    if durability == DurabilityPolicy.BEST_AVAILABLE:
        unanimous = offers and all(offer[1] == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
        durability = DurabilityPolicy.TRANSIENT_LOCAL if unanimous else DurabilityPolicy.VOLATILE
    return reliability, durability
