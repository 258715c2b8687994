# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What happens to a node while it works: floods, transitions, settings, silence, strangers."""

import re
import threading
from collections.abc import Callable
from typing import Any

import rclpy
from lifecycle_msgs.msg import Transition
from live_world import PATIENCE, SECOND, World
from rclpy.context import Context
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger


def burst(world: World) -> str:
    """Frames faster than they can be localized: each is answered or counted."""

    def summary() -> Any:
        return world.node.statistics.summary()

    before = summary()
    for _ in range(300):
        world.send(world.cloud())

    def rest() -> int:
        now = summary()
        done = now.answered + now.refused + now.replaced
        return sum(now.received.values()) - done

    world.wait(lambda: sum(summary().received.values()) > sum(before.received.values()))
    world.until(lambda: False, 0.2)
    world.wait(lambda: rest() == 0)
    assert summary().replaced > before.replaced
    assert world.diagnosis("Frames replaced = [1-9]")
    return "replaced"


def setting(**values: object) -> Callable[[World], str]:
    return lambda world: world.set(**values)


def impossible(transition: int) -> Callable[[World], str]:
    def do(world: World) -> str:
        assert not world.change_state(transition)
        return "success: false"

    return do


def slow(world: World) -> Callable[[], None]:
    """The next frame is worked on until the returned function is called."""
    started, go_on = threading.Event(), threading.Event()
    frames = world.node._localizer
    localize = frames.localize

    def wait(message: Any) -> Any:
        del frames.localize
        started.set()
        assert go_on.wait(PATIENCE)
        return localize(message)

    frames.localize = wait
    while not started.wait(0.1):
        world.send(world.cloud())
    return go_on.set


def deactivated(world: World) -> str:
    """Deactivated while a frame is worked on: it is not published any more."""
    before, sent = len(world.peer.poses), world.stamp
    go_on = slow(world)
    assert world.change_state(Transition.TRANSITION_DEACTIVATE)
    go_on()
    assert world.diagnosis("OK: the node is inactive: activate it")
    stamps = [pose.header.stamp for pose in world.peer.poses[before:]]
    # Poses of earlier frames may still have been on their way.
    assert all(stamp.sec * SECOND + stamp.nanosec <= sent for stamp in stamps)
    assert world.change_state(Transition.TRANSITION_ACTIVATE)
    world.wait(world.peer.connected)
    return "the node is inactive: activate it"


def cleaned_up(world: World) -> str:
    """Back to the start while a frame is worked on, and all over again."""
    go_on = slow(world)
    for transition in (
        Transition.TRANSITION_DEACTIVATE,
        Transition.TRANSITION_CLEANUP,
        Transition.TRANSITION_CONFIGURE,
        Transition.TRANSITION_ACTIVATE,
    ):
        assert world.change_state(transition)
    go_on()
    world.wait(world.peer.connected)
    assert world.diagnosis("waiting for camera_info")
    return "waiting for camera_info"


def reset(world: World) -> str:
    """While a frame is worked on."""
    go_on = slow(world)
    answer = world.call(Trigger, "reset", Trigger.Request())
    go_on()
    assert answer.success
    return str(answer.message)


def stuck(world: World) -> str:
    """Diagnostics and parameters go on while a frame takes long."""
    go_on = slow(world)
    assert world.set(min_inliers=13) == ""
    assert world.set(min_inliers=12) == ""
    assert world.diagnosis(r"WARN: a frame has been worked on for \d")
    go_on()
    return "a frame has been worked on for 1 s"


def bug(world: World) -> Any:
    frames = world.node._localizer

    def fail(message: Any) -> Any:
        del frames.localize
        raise TypeError("a bug")

    frames.localize = fail
    return [world.cloud()]


def simulated_time(world: World) -> str:
    """Without a clock time stands still at zero; with one it may run backwards."""
    assert world.set(use_sim_time=True) == ""
    assert world.poses(world.cloud())
    before = len(world.peer.diagnoses)
    world.wait(lambda: len(world.peer.diagnoses) >= before + 2)
    clock = world.peer.node.create_publisher(Clock, "/clock", 10)
    for second in (100, 50, 200):
        message = Clock()
        message.clock.sec = second
        world.wait(clock.get_subscription_count)
        clock.publish(message)
        world.wait(
            lambda second=second: world.node.get_clock().now().nanoseconds == second * SECOND
        )
        assert world.poses(world.cloud())
    world.peer.node.destroy_publisher(clock)
    assert world.set(use_sim_time=False) == ""
    return "diagnostics go on"


def silence(world: World) -> str:
    """No frame for some seconds, though there is a publisher."""
    assert world.diagnosis("STALE: no frame has come for [2-9] s; /correspondences: it has 1 pub")
    assert world.diagnosis("Topic /correspondences = silent for .*1 publisher, but no message")
    return "STALE: no frame has come"


def second_node(arguments: tuple[str, ...], kind: Any, qos: Any) -> Callable[[World], str]:
    """Another node in this process; what its diagnostics say of a publisher that does not fit."""

    def do(world: World) -> str:
        other = World(world.recording, *arguments, namespace="/other")
        stranger = Context()
        rclpy.init(context=stranger)
        try:
            assert other.localizes()
            assert world.localizes()
            for publisher in other.peer._publishers.values():
                other.peer.node.destroy_publisher(publisher)
            driver = Node("driver", context=stranger, namespace="/other")
            driver.create_publisher(kind, "correspondences", qos)
            pattern = "Topic /other/correspondences = silent .*/other/driver"
            assert other.diagnosis(pattern)
            return next(item for item in other.peer.diagnoses if re.search(pattern, item))
        finally:
            rclpy.shutdown(context=stranger)
            other.close()

    return do
