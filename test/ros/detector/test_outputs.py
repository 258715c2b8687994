# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What a detector publishes from its worker, while the executor closes it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import PointCloud2

from rs_localizer.ros.detector import image_node
from rs_localizer.ros.detector.image_node import ImageOutputs

from ..node.test_worker import waits  # noqa: TID252 - Python has a package "test"


class Publisher:
    """One that is heard, and does something while it publishes."""

    def __init__(self, kind: type, topic: str) -> None:
        self.topic_name = topic
        self.sent: list[Any] = []
        self.destroyed = False
        self.while_publishing = lambda: None

    def get_subscription_count(self) -> int:
        return 1

    def publish(self, message: Any) -> None:
        assert not self.destroyed
        self.while_publishing()
        assert not self.destroyed
        self.sent.append(message)


@pytest.fixture
def made(monkeypatch) -> tuple[ImageOutputs[int], list[Publisher]]:
    publishers: list[Publisher] = []

    def create(node: Any, kind: type, topic: str) -> Publisher:
        publishers.append(Publisher(kind, topic))
        return publishers[-1]

    monkeypatch.setattr(image_node, "create_output", create)
    node = SimpleNamespace(destroy_lifecycle_publisher=lambda one: setattr(one, "destroyed", True))
    picture = np.zeros((2, 3, 3), np.uint8)
    outputs: ImageOutputs[int] = ImageOutputs(
        node, "/clouds", lambda result, make: PointCloud2(width=result),
        lambda result: (SimpleNamespace(stamp_ns=5, frame="camera"), picture),
    )  # fmt: skip
    return outputs, publishers


def test_who_closes_waits_until_what_is_being_published_is_out(made):
    outputs, (clouds, pictures) = made
    waited: list[bool] = []
    clouds.while_publishing = lambda: waited.append(waits(outputs.close))
    outputs.publish(7)
    assert waited == [True]
    assert [one.width for one in clouds.sent] == [7]
    assert len(pictures.sent) == 1


def test_nothing_is_published_once_it_is_closed(made):
    outputs, publishers = made
    assert outputs.wanted
    outputs.close()
    outputs.publish(7)
    assert not outputs.wanted
    assert all(one.destroyed and not one.sent for one in publishers)
