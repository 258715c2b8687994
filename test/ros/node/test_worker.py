# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The worker of a node: which frames it takes, when it publishes; and a manager of nodes."""

import importlib.util
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from sensor_msgs.msg import Image, JointState

from rs_localizer.core.reasons import Reason
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.ros.node.conversion import message_class
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.statistics import Statistics
from rs_localizer.ros.node.worker import Worker, wait_for_workers

from ..conftest import RUN  # noqa: TID252 - Python has a package "test"

PATIENCE = 3500.0  # s: what has not come by then hangs


class Count(Statistics[str]):
    """Frames are plain text here, without stamps."""

    def received(self, topic: str, message: Any) -> None:
        super().received(topic, Image())

    def answered(self, result: str, received: float) -> None:
        assert received <= time.monotonic()
        super().answered(result, received)


def waits(function: Callable[[], Any]) -> bool:
    """Whether another thread that calls it has to wait for this one."""
    thread = threading.Thread(target=function, daemon=True)
    thread.start()
    thread.join(0.2)
    return thread.is_alive()


class Fake:
    def __init__(self) -> None:
        self.settings = "old"
        self.started = threading.Semaphore(0)
        self.go_on = threading.Semaphore(0)
        self.published: list[str] = []
        self.done = threading.Semaphore(0)
        self.awaited: set[str] = set()
        self.while_publishing: Callable[[], Any] = lambda: None
        self.refusals = Refusals(lambda text: None)
        self.statistics = Count(self.refusals, lambda text: (0, text))
        self.patience_of_frames = PATIENCE
        self.worker: Worker[str] = Worker(
            lambda _, frame: self._localize(frame), self._publish, self.statistics, pytest.fail,
            lambda frame: self.patience_of_frames if frame in self.awaited else 0.0,
        )  # fmt: skip

    def send(self, frame: str, topic: str = "frames") -> None:
        self.worker.process(topic, frame)

    def wait(self, semaphore: threading.Semaphore) -> None:
        assert semaphore.acquire(timeout=PATIENCE)

    def begin(self, frame: str) -> None:
        """Send a frame, which is then being worked on."""
        self.send(frame)
        self.wait(self.started)

    def finish(self, frames: int, published: int) -> list[str]:
        """Let so many frames be worked on, until so many are published: all that are."""
        self.go_on.release(frames)
        for _ in range(published):
            self.wait(self.done)
        return self.published

    def _localize(self, frame: Any) -> Any:
        if isinstance(frame, Iterator):
            return frame
        self.started.release()
        before = self.settings
        assert self.go_on.acquire(timeout=PATIENCE)
        assert self.settings == before
        return f"{frame} {self.settings}"

    def _publish(self, frame: Any) -> None:
        self.while_publishing()
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
    fake.begin("one")
    for frame in ("two", "three", "four"):
        fake.send(frame)
    assert fake.finish(2, 2) == ["one old", "four old"]
    summary = fake.statistics.summary()
    assert summary.total == {"received": 4, "answered": 2, "replaced": 2}


def test_updates_come_before_the_next_frame_and_never_within_one(fake):
    order: list[str] = []

    def change(text: str) -> None:
        order.append(text)
        fake.settings = text

    fake.begin("one")
    fake.send("two")
    fake.worker.update("settings", partial(change, "newer"))
    fake.worker.update("camera", lambda: order.append("camera"))
    fake.worker.update("settings", partial(change, "newest"))
    assert fake.finish(2, 2) == ["one old", "two newest"]
    assert order == ["camera", "newest"]


def test_nothing_is_published_after_a_pause(fake):
    fake.begin("one")
    fake.send("two")
    fake.worker.pause()  # does not wait for the frame
    fake.send("three")
    assert fake.finish(2, 1) == ["three old"]
    assert fake.statistics.summary().total["dropped"] == 2  # none is lost unseen


@pytest.mark.parametrize("end", ["pause", "close"])
def test_who_pauses_or_closes_waits_until_what_is_being_published_is_out(fake, end):
    """Afterwards publishers are destroyed."""
    waited: list[bool] = []
    fake.while_publishing = lambda: waited.append(waits(getattr(fake.worker, end)))
    fake.go_on.release()
    fake.send("one")
    fake.wait(fake.done)
    assert waited == [True]


class Entered:
    """A lock before which something happens, as when another thread comes first."""

    def __init__(self, lock: Any, before: Callable[[], Any]) -> None:
        self._lock, self._before = lock, before

    def __enter__(self) -> None:
        self._before()
        self._lock.__enter__()

    def __exit__(self, *error: object) -> None:
        self._lock.__exit__(*error)


def test_a_pause_just_before_something_is_published_still_counts(fake):
    lock = fake.worker._publishing
    paused = threading.Semaphore(0)

    def pause() -> None:
        fake.worker._publishing = lock
        fake.worker.pause()
        paused.release()

    fake.worker._publishing = Entered(lock, pause)
    fake.go_on.release(2)
    fake.send("one")
    fake.wait(paused)
    fake.send("two")
    fake.wait(fake.done)
    assert fake.published == ["two old"]
    total = fake.statistics.summary().total
    assert (total["received"], total["dropped"]) == (2, 1)


def test_a_worker_that_is_closed_publishes_nothing_more(fake):
    """Neither what it works on nor what comes."""
    fake.begin("one")
    fake.worker.close()
    fake.go_on.release(10)
    assert wait_for_workers(PATIENCE)
    fake.send("two")
    assert fake.published == []


def test_all_results_of_a_message_are_published_as_they_come(fake):
    """As of a rig's image, which may complete two frames; one refusal ends none of them."""
    refusal = Refusal(Reason.NO_STAMP, "none")
    fake.worker.process("frames", iter(["a", refusal, "b", "c"]))
    for _ in "abc":
        fake.wait(fake.done)
    fake.go_on.release()
    fake.send("next")
    fake.wait(fake.done)
    assert fake.published == ["a", "b", "c", "next old"]
    total = fake.statistics.summary().total
    assert (total["received"], total["answered"], total["refused"]) == (2, 4, 1)


def test_what_an_update_of_nobody_foresaw_is_told_and_the_next_is_done():
    told: list[str] = []
    done = threading.Semaphore(0)
    worker: Worker[str] = Worker(print, print, Count(Refusals(print), print), told.append)

    def fail() -> None:
        raise TypeError("a bug")

    worker.update("one", fail)
    worker.update("other", done.release)
    assert done.acquire(timeout=PATIENCE)
    worker.close()
    assert wait_for_workers(PATIENCE)
    assert len(told) == 1
    assert "a bug" in told[0]


def test_a_frame_waits_for_what_it_needs_but_not_for_long(fake):
    fake.awaited = {"one"}
    fake.send("one")
    fake.send("two", topic="others")  # those behind it wait, too
    changed = threading.Semaphore(0)
    fake.worker.update("settings", changed.release)
    fake.wait(changed)
    while not fake.worker._waiting:
        time.sleep(0.001)
    assert fake.published == []
    fake.awaited.clear()
    assert fake.finish(2, 2) == ["one old", "two old"]
    fake.awaited, fake.patience_of_frames = {"three"}, 0.05
    fake.send("three")
    assert fake.finish(1, 1) == ["one old", "two old", "three old"]


INSTALLED = importlib.util.find_spec("bond") is not None
# The messages of bond are not on PyPI. A JointState carries their fields where there are none.
_STAND_IN = """
import sys, types
from sensor_msgs.msg import JointState
def init(self, id, instance_id, active, heartbeat_timeout, heartbeat_period):
    JointState.__init__(self, name=[id, instance_id], position=[float(active), heartbeat_timeout])
module = types.ModuleType("bond.msg")
module.Status = type("JointState", (JointState,), {"__init__": init,
    "__module__": JointState.__module__})
sys.modules |= {"bond": types.ModuleType("bond"), "bond.msg": module}
"""
BOND_TIMEOUT = 4.0  # nav2's default
# A request that has no answer by then (s) is lost: the manager would wait for ever.
LOST = 120.0
CONFIGURE, ACTIVATE = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE
PAUSE, RESET = Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP
END = Transition.TRANSITION_UNCONFIGURED_SHUTDOWN
STATES = {
    CONFIGURE: State.PRIMARY_STATE_INACTIVE, ACTIVATE: State.PRIMARY_STATE_ACTIVE,
    PAUSE: State.PRIMARY_STATE_INACTIVE, RESET: State.PRIMARY_STATE_UNCONFIGURED,
    END: State.PRIMARY_STATE_FINALIZED,
}  # fmt: skip


class Bond:
    """One end of a bond, as nav2's manager listens to the node's."""

    def __init__(self, node: Any) -> None:
        self.instances: list[str] = []
        self.is_alive, self.gap, self._heard = False, 0.0, 0.0
        kind = message_class("bond/msg/Status") if INSTALLED else JointState
        node.create_subscription(kind, "bond", self._hear, 30)

    def _hear(self, status: Any) -> None:
        if INSTALLED:
            name, instance, active = status.id, status.instance_id, status.active
        else:
            (name, instance), (active, _) = status.name, status.position
        assert name == "rs_localizer"
        now = time.monotonic()
        if self.is_alive:
            self.gap = max(self.gap, now - self._heard)
        self._heard, self.is_alive = now, bool(active)
        if instance not in self.instances:
            self.instances.append(instance)


def test_nav2_starts_pauses_resets_and_shuts_down_the_node(start_node, peer):
    """As nav2_lifecycle_manager does it (branch jazzy, f4108e5), with one node.

    It waits until both services are there, then sends each request once: the transition, and the
    question whether its state has come. A bond has to form in half of its timeout after the
    activation, and is broken by the node's last word or its silence.
    """
    run = RUN if INSTALLED else _STAND_IN + RUN
    node = start_node("-p", "autostart:=false", "-p", "readout_time:=0.02", run=run)
    services = ((ChangeState, "change_state"), (GetState, "get_state"))
    clients = {k: peer.node.create_client(k, f"rs_localizer/{name}") for k, name in services}
    bond = Bond(peer.node)

    def ask(kind: Any, request: Any) -> Any:
        assert peer.spin_until(clients[kind].service_is_ready, LOST)
        answer = clients[kind].call_async(request)
        assert peer.spin_until(answer.done, LOST), f"no answer to {request}"
        return answer.result()

    def change(*transitions: int) -> None:
        for transition in transitions:
            request = ChangeState.Request(transition=Transition(id=transition))
            assert ask(ChangeState, request).success
            assert ask(GetState, GetState.Request()).current_state.id == STATES[transition]
            # When it pauses the node says that it leaves: nobody has to wait for the timeout.
            alive = transition == ACTIVATE
            assert peer.spin_until(lambda alive=alive: bond.is_alive == alive, BOND_TIMEOUT / 2)

    change(CONFIGURE, ACTIVATE)
    assert not peer.spin_until(lambda: not bond.is_alive, 1.0)
    # Paused and resumed; a bond must not be taken for the one before.
    change(PAUSE, ACTIVATE)
    assert not peer.spin_until(lambda: not bond.is_alive, 1.0)
    change(PAUSE, RESET, CONFIGURE, ACTIVATE)
    assert len(bond.instances) == 3
    assert bond.gap < BOND_TIMEOUT
    change(PAUSE, RESET, END)
    assert node.stop() == 0
    assert "Traceback" not in node.log
    assert "bond_timeout 0.0" not in node.log  # which it says where the package is missing
