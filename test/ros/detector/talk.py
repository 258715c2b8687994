# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A camera before a detector, and somebody who hears it."""

from collections.abc import Callable
from typing import Any

from sensor_msgs.msg import CompressedImage, Image

TOPICS = {Image: "/image", CompressedImage: "/image/compressed"}


class Talk:
    """Publishes images; listens only when told to."""

    def __init__(self, peer: Any, node: str, kind: type = Image) -> None:
        self.peer = peer
        self._node = node
        self.heard: dict[str, list[Any]] = {}
        self.open(kind)

    def open(self, kind: type) -> None:
        self.publisher = self.peer.node.create_publisher(kind, TOPICS[kind], 1)

    def listen(self, kind: type, topic: str) -> Any:
        kept = self.heard.setdefault(topic, [])
        return self.peer.node.create_subscription(kind, topic, kept.append, 10)

    def listeners(self, count: int) -> bool:
        return bool(self.peer.spin_until(lambda: self.publisher.get_subscription_count() == count))

    def send_until(self, message: Any, condition: Callable[[], Any]) -> None:
        """Any of them may be lost."""
        self.publisher.publish(message)
        while not self.peer.spin_until(condition, 0.5):
            self.publisher.publish(message)

    def ask(self, message: Any, topic: str) -> Any:
        def answers() -> list[Any]:
            heard = self.heard[topic]
            return [m for m in heard if m.header.stamp.sec == message.header.stamp.sec]

        self.send_until(message, answers)
        return answers()[0]

    def set(self, name: str, value: object) -> tuple[bool, str]:
        answer: tuple[bool, str] = self.peer.set(f"/{self._node}", name, value)
        return answer

    def reported(self, wanted: dict[str, str | None]) -> bool:
        """Whether the diagnostics have had these values at once; None: any but 0."""
        found = [s for m in self.heard["/diagnostics"] for s in m.status if self._node in s.name]
        return any(
            all(
                values.get(k, "0") != "0" if value is None else values.get(k) == value
                for k, value in wanted.items()
            )
            for values in ({item.key: item.value for item in s.values} for s in found)
        )
