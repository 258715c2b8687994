# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The worker: nothing waits for a slow frame, the newest wins, and every frame is accounted for."""

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from sensor_msgs.msg import Image

from rs_localizer.pipeline.refusal import Waiting
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.statistics import Statistics
from rs_localizer.ros.node.worker import Need, Worker, wait_for_workers

PATIENCE = 3500.0  # s: what has not come by then hangs


class Count(Statistics[str]):
    """Frames are plain text here, without stamps."""

    def received(self, topic: str, message: Any) -> None:
        super().received(topic, Image())

    def answered(self, result: str, received: float) -> None:
        assert received <= time.monotonic()
        super().answered(result, received)


class Fake:
    """Stands in for the localizer of the frames."""

    def __init__(self) -> None:
        self.settings = "old"
        self.started = threading.Semaphore(0)
        self.go_on = threading.Semaphore(0)
        self.published: list[str] = []
        self.done = threading.Semaphore(0)
        self.mounted: set[str] = set()
        self.awaited: set[str] = set()
        self.patience = PATIENCE
        self.refusals = Refusals(lambda text: None)
        self.statistics = Count(self.refusals, lambda text: (0, text))
        self.worker: Worker[Fake, str] = Worker(self, self._publish, self.statistics, pytest.fail)

    def send(self, frame: str, topic: str = "frames", patience: float = PATIENCE) -> None:
        need: Need[Fake] = Need(lambda frames, message: message in self.awaited, patience)
        self.worker.process(topic, frame, lambda frames, message: self._localize(message), need)

    def wait(self, semaphore: threading.Semaphore) -> None:
        assert semaphore.acquire(timeout=PATIENCE)

    def _localize(self, frame: str) -> Any:
        self.started.release()
        before = self.settings
        assert self.go_on.acquire(timeout=PATIENCE)
        assert self.settings == before
        if frame.startswith("late"):
            return self._waiting(frame)
        return f"{frame} {self.settings}"

    def _waiting(self, frame: str) -> Any:
        def again() -> Any:
            return frame if frame in self.mounted else self._waiting(frame)

        return Waiting("no_transform", "not yet", again, self.patience)

    def _publish(self, frame: Any) -> None:
        self.published.append(frame)
        self.done.release()


@pytest.fixture
def fake() -> Iterator[Fake]:
    fake = Fake()
    yield fake
    fake.worker.close()
    fake.go_on.release(100)
    assert wait_for_workers(PATIENCE)


def test_the_newest_frame_wins_and_what_it_replaced_is_counted(fake):
    fake.send("one")
    fake.wait(fake.started)
    for frame in ("two", "three", "four"):
        fake.send(frame)
    fake.go_on.release(2)
    fake.wait(fake.done)
    fake.wait(fake.done)
    assert fake.published == ["one old", "four old"]
    summary = fake.statistics.summary()
    assert summary.total == {"received": 4, "answered": 2, "replaced": 2}


def test_updates_come_before_the_next_frame_and_never_within_one(fake):
    order: list[str] = []

    def settings(text: str) -> Any:
        def change(frames: Any) -> None:
            order.append(text)
            fake.settings = text

        return change

    fake.send("one")
    fake.wait(fake.started)
    fake.send("two")
    fake.worker.update("settings", settings("newer"))
    fake.worker.update("camera", lambda frames: order.append("camera"))
    fake.worker.update("settings", settings("newest"))
    fake.go_on.release(2)
    fake.wait(fake.done)
    fake.wait(fake.done)
    assert fake.published == ["one old", "two newest"]
    assert order == ["camera", "newest"]


def test_nothing_is_published_after_a_pause(fake):
    fake.send("one")
    fake.wait(fake.started)
    fake.send("two")
    fake.worker.pause()  # does not wait for the frame
    fake.send("three")
    fake.go_on.release(2)
    fake.wait(fake.done)
    assert fake.published == ["three old"]
    assert fake.statistics.summary().total["dropped"] == 2  # none is lost unseen


def test_a_late_mounting_keeps_no_other_frame_waiting(fake):
    fake.go_on.release(4)
    for frame in ("late 1", "late 2", "next"):
        fake.send(frame)
        fake.wait(fake.started)
    fake.wait(fake.done)
    assert fake.published == ["next old"]
    fake.mounted = {"late 2"}  # later ones wait for the first
    time.sleep(0.05)
    assert fake.published == ["next old"]
    fake.mounted = {"late 1", "late 2"}
    fake.wait(fake.done)
    fake.wait(fake.done)
    assert fake.published == ["next old", "late 1", "late 2"]
    assert fake.statistics.summary().total["refused"] == 0


def test_a_frame_waits_for_what_it_needs_but_not_for_long(fake):
    fake.go_on.release(3)
    fake.awaited = {"one"}
    fake.send("one")
    fake.send("two", topic="others")  # those behind it wait, too
    time.sleep(0.05)
    assert fake.published == []
    fake.awaited.clear()
    fake.worker.look()
    fake.wait(fake.done)
    fake.wait(fake.done)
    fake.awaited = {"three"}
    fake.send("three", patience=0.05)
    fake.wait(fake.done)
    assert fake.published == ["one old", "two old", "three old"]
