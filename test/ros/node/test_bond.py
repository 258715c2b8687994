# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The bond as nav2's lifecycle manager sees it: by the state machine of bondcpp."""

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from rclpy.clock import Clock

from rs_localizer.ros.node.bond import Bond
from rs_localizer.ros.node.conversion import message_class


class Status(SimpleNamespace):
    """Stands in for bond/msg/Status."""

    def __init__(self, **fields: Any) -> None:
        super().__init__(header=SimpleNamespace(stamp=None), **fields)


class Manager:
    """One side of a bond: waiting for its sister, alive, or dead."""

    def __init__(self, id_: str, timeout: float) -> None:
        self._id, self._timeout = id_, timeout
        self.state, self._heard, self.now = "waiting", 0.0, 0.0

    def hear(self, status: Status) -> None:
        if status.id != self._id or status.instance_id == "the manager's own":
            return
        self._heard = self.now
        if not status.active:
            self.state = "dead"
        elif self.state == "waiting":
            self.state = "alive"

    def tick(self, seconds: float) -> None:
        self.now += seconds
        if self.state == "alive" and self.now - self._heard > self._timeout:
            self.state = "dead"


class Bench:
    """A bond without a graph, whose timer is turned by hand."""

    def __init__(self, manager: Manager) -> None:
        self.manager, self.listeners, self.destroyed = manager, 1, 0
        self.sent: list[Status] = []
        publisher = SimpleNamespace(
            publish=self._publish, get_subscription_count=lambda: self.listeners
        )
        node: Any = SimpleNamespace(
            get_name=lambda: "rs_localizer",
            create_publisher=self._created(publisher),
            create_timer=self._timer,
            get_clock=Clock,
            context=SimpleNamespace(ok=lambda: True),
            destroy_timer=self._destroy,
            destroy_publisher=self._destroy,
        )
        self.bond = Bond(node)

    def _created(self, publisher: Any) -> Any:
        def create(kind: type, topic: str, depth: int) -> Any:
            assert (kind, topic) == (Status, "bond")
            return publisher

        return create

    def _timer(self, period: float, callback: Any, clock: Any) -> None:
        self._period, self._callback = period, callback

    def _destroy(self, item: Any) -> None:
        self.destroyed += 1

    def _publish(self, status: Status) -> None:
        self.sent.append(status)
        self.manager.hear(status)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / self._period)):
            self.manager.tick(self._period)
            self._callback()


@pytest.fixture
def bench(monkeypatch) -> Bench:
    messages = ModuleType("bond.msg")
    messages.Status = Status  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "bond", ModuleType("bond"))
    monkeypatch.setitem(sys.modules, "bond.msg", messages)
    monkeypatch.setattr("rs_localizer.ros.node.bond.message_class", message_class.__wrapped__)
    return Bench(Manager("rs_localizer", 4.0))


def test_a_bond_forms_and_holds(bench):
    bench.run(1.9)  # the manager waits for half of its timeout
    assert bench.manager.state == "alive"
    bench.run(60.0)
    assert bench.manager.state == "alive"
    (instance,) = {status.instance_id for status in bench.sent}
    assert len(instance) == 36  # a UUID: the manager takes its own messages by theirs
    assert all(status.heartbeat_timeout == 4.0 for status in bench.sent)


def test_a_node_that_hangs_is_missed_and_one_that_leaves_says_so(bench):
    bench.run(1.0)
    bench.manager.tick(3.9)
    assert bench.manager.state == "alive"
    bench.manager.tick(0.2)
    assert bench.manager.state == "dead"
    bench.manager.state = "alive"
    bench.bond.close()
    assert bench.manager.state == "dead"
    assert bench.destroyed == 2


def test_nothing_is_sent_where_nobody_listens(bench):
    bench.listeners = 0
    bench.run(1.0)
    bench.bond.close()
    assert bench.sent == []
