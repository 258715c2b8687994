# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""TF in the node. Where tf2_ros is installed the same tests run with it."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from rclpy.time import Time

from rs_localizer.config import NodeConfig
from rs_localizer.io.outputs import BodyPose, Localized
from rs_localizer.io.transforms import TransformError
from rs_localizer.ros.localizer.tf import Broadcaster, check

from ..node.test_worker import waits  # noqa: TID252 - Python has a package "test"
from .robot import tf2_ros

Notes = list[tuple[str, str]]
HALF_TURN, NO_TURN = (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def robot(peer) -> Any:
    """Sends transforms, and hears what comes on TF."""
    with tf2_ros() as tf2:
        moving = tf2.TransformBroadcaster(peer.node)
        static: list[Any] = []

        def send(
            parent: str, child: str, x: float, stamp_ns: int = 0, turn: Any = HALF_TURN
        ) -> None:
            item = TransformStamped(child_frame_id=child)
            item.header.frame_id = parent
            item.header.stamp.sec, item.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            item.transform.translation.x = x
            q = item.transform.rotation
            q.x, q.y, q.z, q.w = turn
            if stamp_ns:
                moving.sendTransform(item)
            else:  # tf2_ros of Jazzy sends the first transform of a child for ever
                static.append(tf2.StaticTransformBroadcaster(peer.node))
                static[-1].sendTransform(item)

        buffer = tf2.Buffer()
        listener = tf2.TransformListener(buffer, peer.node)
        yield SimpleNamespace(send=send, buffer=buffer)
        listener.unregister()


@pytest.fixture
def made(peer, robot) -> Iterator[Callable[..., Any]]:
    """Makes the node's TF, in a node and a thread of their own as the executor is."""
    parts: list[Any] = []

    def make(**settings: Any) -> SimpleNamespace:
        notes: Notes = []

        def keep(*words: str) -> None:
            notes.append(words)

        broadcaster = Broadcaster(peer.node, SimpleNamespace(notice=keep))
        config = NodeConfig(**settings)
        broadcaster.configure(config)
        parts.append(broadcaster)
        return SimpleNamespace(
            tf=broadcaster.tf, publish=broadcaster.publish, notes=notes, config=config,
            broadcaster=broadcaster,
        )  # fmt: skip

    yield make
    for part in parts:
        part.close()


def frame(stamp_ns: int, x: float = 0.0) -> Localized:
    pose = BodyPose(np.array([x, 0.0, 0.0]), np.eye(3), np.eye(6))
    return Localized(
        input_stamp_ns=stamp_ns, stamp_ns=stamp_ns, map_frame="map", body_frame="base_link",
        pose=pose, twist=None, inliers=np.zeros(0), dropped=0, estimate=None,
    )  # fmt: skip


def awaited(peer: Any, ask: Callable[[], Any]) -> Any:
    """What is answered, once there is an answer."""
    found: list[Any] = []

    def there() -> bool:
        with contextlib.suppress(Exception):  # tf2_ros' or its stand-in's
            found.append(ask())
        return bool(found)

    assert peer.spin_until(there), "no transform"
    return found[0]


def known(made: Any, peer: Any, target: str, source: str, stamp_ns: int) -> None:
    awaited(peer, lambda: made.tf.lookup(target, source, stamp_ns))


def heard(robot: Any, peer: Any, parent: str, child: str, stamp_ns: int = 0) -> Any:
    """What another node makes of what was sent."""
    at = Time(nanoseconds=stamp_ns)
    return awaited(peer, lambda: robot.buffer.lookup_transform(parent, child, at))


@pytest.mark.parametrize("turn", [(0.0,) * 4, (float("nan"),) * 4])
def test_a_transform_without_a_rotation_is_named(made, robot, peer, turn):
    node = made(publish_tf="map_to_odom")
    robot.send("odom", "base_link", 0.0, turn=turn)

    def said() -> str:
        try:
            node.tf.lookup("odom", "base_link", None)
        except TransformError as error:
            return str(error)
        return ""

    assert peer.spin_until(lambda: "'base_link' in 'odom' on TF the quaternion" in said())
    assert "is not a rotation" in said()


def test_the_correction_never_stops(made, robot, peer):
    node = made(publish_tf="map_to_odom", transform_tolerance=0.2, hold=3.0)
    assert not node.notes
    node.publish(frame(5_000_000_000), node.config)
    assert node.notes[0][0] == "not_broadcast"
    assert "does not exist" in node.notes.pop()[1]
    for tenth in range(50, 61):
        robot.send("odom", "base_link", 0.1 * tenth, tenth * 10**8, NO_TURN)
    known(node, peer, "odom", "base_link", 6 * 10**9)
    node.publish(frame(5_500_000_000, x=5.5), node.config)
    # No frame comes any more, odometry does.
    for tenth in range(61, 80):
        robot.send("odom", "base_link", 0.1 * tenth, tenth * 10**8, NO_TURN)
        base = heard(robot, peer, "map", "base_link", tenth * 10**8 - 5 * 10**7)
        assert base.transform.translation.x == pytest.approx(0.1 * tenth - 0.05)
    known(node, peer, "odom", "base_link", 7_900_000_000)
    peer.spin_until(lambda: node.broadcaster.holding.seconds > 2.35)
    assert str(node.broadcaster.holding).startswith("holding for 2.4 s, ")
    # A frame that contradicts it beyond all drift is told; it counts all the same.
    node.publish(frame(7_800_000_000, x=97.8), node.config)
    ((_, text),) = [note for note in node.notes if note[0] == "map_jumped"]
    assert "jumps by 9e+03 cm" in text
    # After hold it ends.
    for tenth in range(80, 115):
        robot.send("odom", "base_link", 0.1 * tenth, tenth * 10**8, NO_TURN)
    known(node, peer, "odom", "base_link", 11_400_000_000)
    peer.spin_until(lambda: False, 0.3)
    with pytest.raises(Exception, match="future"):
        robot.buffer.lookup_transform("map", "base_link", Time(nanoseconds=11_300_000_000))
    assert str(node.broadcaster.holding).startswith("not sent since hold ended, 3.6 s after the ")


def test_without_tf2_ros_only_what_needs_it_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    check(NodeConfig())
    check(NodeConfig(transform_tolerance=3.0))
    package = "the Python package tf2_ros.* sudo apt install ros-jazzy-tf2-ros-py"
    with pytest.raises(ValueError, match=f"^base_frame 'base_link' needs {package}$"):
        check(NodeConfig(base_frame="base_link"))
    with pytest.raises(ValueError, match=f"^publish_tf map_to_odom needs {package}$"):
        check(NodeConfig(publish_tf="map_to_odom"))


@pytest.mark.parametrize("other", ["forget", "_tick"])
def test_others_wait_until_what_is_being_sent_is_out(made, peer, robot, monkeypatch, other):
    """Who forgets, as after it nothing of the frames so far is sent; and the timer."""
    node = made(publish_tf="map_to_odom", transform_tolerance=0.2)
    for tenth in range(50, 61):
        robot.send("odom", "base_link", 0.1 * tenth, tenth * 10**8, NO_TURN)
    known(node, peer, "odom", "base_link", 6 * 10**9)
    broadcaster, waited = node.broadcaster._broadcaster, []
    send = broadcaster.sendTransform

    def sending(item: Any) -> None:
        waited.append(waits(getattr(node.broadcaster, other)))
        send(item)

    monkeypatch.setattr(broadcaster, "sendTransform", sending)
    node.publish(frame(5_500_000_000, x=5.5), node.config)
    assert waited[:1] == [True]
