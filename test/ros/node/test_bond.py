# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The bond with nav2's lifecycle manager, by the protocol of ros/bond_core."""

import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.context import Context
from rclpy.parameter import Parameter

from rs_localizer.ros.localizer.node import LocalizerNode
from rs_localizer.ros.node.conversion import message_class
from rs_localizer.ros.node.managed import Bond


class Node:
    """As far as a bond needs one: there is no type support of bond.msg for a real one."""

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.ticking = True

    def get_name(self) -> str:
        return "rs_localizer"

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        assert topic == "bond"
        return SimpleNamespace(publish=self.sent.append)

    def create_subscription(
        self, _: Any, topic: str, take: Callable[[Any], None], depth: int
    ) -> Any:
        self.take = take

    def create_timer(self, period: float, tick: Callable[[], None], clock: Any) -> Any:
        self.period, self.tick = period, tick
        return SimpleNamespace(cancel=lambda: setattr(self, "ticking", False))

    def destroy_timer(self, timer: Any) -> None:
        timer.cancel()

    def destroy_publisher(self, _: Any) -> None: ...

    destroy_subscription = destroy_publisher


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setitem(sys.modules, "bond.msg", SimpleNamespace(Status=SimpleNamespace))
    yield Node()
    message_class.cache_clear()


def test_heartbeats_until_the_end(node: Any) -> None:
    bond = Bond(node, 0.1)
    node.tick()
    node.tick()
    bond.close()
    assert [(status.id, status.active) for status in node.sent] == [
        ("rs_localizer", True),
        ("rs_localizer", True),
        ("rs_localizer", False),
    ]
    assert len({status.instance_id for status in node.sent}) == 1
    assert node.sent[0].heartbeat_timeout > 10 * node.period  # some may be late
    assert not node.ticking


def test_the_managers_end_is_confirmed_and_no_other(node: Any) -> None:
    Bond(node, 0.1)
    node.tick()
    (own,) = node.sent
    for name, instance, active in (
        ("rs_localizer", own.instance_id, False),  # its own, which comes back
        ("map_server", "manager", False),
        ("rs_localizer", "manager", True),
    ):
        node.take(SimpleNamespace(id=name, instance_id=instance, active=active))
    assert (len(node.sent), node.ticking) == (1, True)
    node.take(SimpleNamespace(id="rs_localizer", instance_id="manager", active=False))
    assert (node.sent[-1].active, node.ticking) == (False, False)


def test_without_the_package_it_is_refused_at_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bond.msg", None)
    message_class.cache_clear()
    context = Context()
    context.init(args=[])
    try:
        wanted = [Parameter("bond_heartbeat_period", value=0.1)]
        with pytest.raises(ValueError, match="needs the package bond"):
            LocalizerNode(context=context, parameter_overrides=wanted)
    finally:
        context.try_shutdown()
