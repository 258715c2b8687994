# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What only a live node can have wrong: what it says of it, and that it localizes afterwards.

What single messages have wrong is tested in ``test/io`` and ``test/pipeline``, what a worker does
with frames in ``test/ros/node``.
"""

import array
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.context import Context
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2, PointField

from benchmarks.fuzzing import map_rows
from rs_localizer.io.bags import typestore
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.outputs import TYPES
from rs_localizer.ros.localizer.node import LocalizerNode
from rs_localizer.ros.node.conversion import make_message
from rs_localizer.ros.node.managed import spin
from rs_localizer.tools.simulation.simulated_recording import random_descriptors

from ..conftest import TIMEOUT, Peer  # noqa: TID252 - Python has a package "test"
from .robot import READOUT_TIME, Robot, inputs, record, tf2_ros

CLOSE = 0.05  # m: the poses are right
SECOND = 1_000_000_000
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
DESCRIPTORS = random_descriptors(5000, np.random.default_rng(9))  # of the landmarks, by number


class World(Robot):
    """A live node in a thread, a robot that talks to it over DDS, and all that the node has said.

    Args:
        bag: to be written: a flight without noise.
    """

    def __init__(self, bag: Path) -> None:
        self.truth = record(bag, noise=0.0, outliers=0.0)[0]  # position of the first frame
        (self.camera_info, *_), self.clouds = zip(*inputs(bag), strict=True)
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = LocalizerNode(
            context=self.context, cli_args=["--ros-args", "-p", f"readout_time:={READOUT_TIME}"]
        )
        # Every single one, where the log leaves out repetitions.
        self.said: list[str] = []
        self.node.refusals.notice = lambda *texts: self.said.append(": ".join(texts))
        assert self.node.trigger_configure().name == self.node.trigger_activate().name == "SUCCESS"
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=spin, args=(self.node, self._stopped.is_set))
        self._thread.start()
        super().__init__(Peer())
        create = self.peer.node.create_publisher
        self.publishers["/keypoints"] = create(PointCloud2, "/keypoints", 10)
        self.publishers["/map_points"] = create(PointCloud2, "/map_points", LATCHED)
        self.stamp = SECOND
        self.connect()

    def cloud(self, table: np.ndarray | None = None) -> PointCloud2:
        """A good frame, later than the last, perhaps with other rows."""
        good = self.clouds[0]
        message = PointCloud2(
            **{name: getattr(good, name) for name in good.get_fields_and_field_types()}
        )
        self.stamp += SECOND // 30
        if table is None:  # in another order: the same image again would be a stream that hangs
            table = np.roll(self.table(), self.stamp // (SECOND // 30))
        message.width, message.row_step = len(table), table.nbytes
        message.data = array.array("B", table.tobytes())
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(self.stamp, SECOND)
        return message

    def table(self, index: int = 0) -> np.ndarray:
        cloud = self.clouds[index]
        kinds = {PointField.FLOAT32: "<f4", PointField.UINT32: "<u4"}
        columns = [(item.name, kinds[item.datatype]) for item in cloud.fields]
        return np.frombuffer(bytes(cloud.data), columns).copy()

    def poses(self, topic: str, message: Any, within: float) -> bool:
        """Send; whether a pose comes."""
        before = len(self.answers["pose"])
        self.publishers[topic].publish(message)
        return bool(self.peer.spin_until(lambda: len(self.answers["pose"]) > before, within))

    def wait(self, condition: Callable[[], Any]) -> None:
        assert self.peer.spin_until(condition), self.said

    def diagnosis(self, state: str) -> None:
        del self.states[:-1]
        self.wait(lambda: any(re.search(state, text) for text in self.states))

    def localizes(self) -> bool:
        """Whether the answer to a good frame is the true position."""
        self.publishers["/camera_info"].publish(self.camera_info)
        # Any of them may be lost while the node follows a publisher's quality.
        while not self.poses("/correspondences", self.cloud(), within=1.0):
            self.publishers["/camera_info"].publish(self.camera_info)
        answer = typestore().deserialize_cdr(self.answers["pose"][-1], TYPES["pose"])
        found = answer.pose.position
        error = np.array([found.x, found.y, found.z]) - self.truth
        return bool(np.linalg.norm(error) < CLOSE)

    def close(self) -> None:
        self._stopped.set()
        self._thread.join()
        self.node.destroy_node()
        self.peer.close()
        rclpy.shutdown(context=self.context)


@pytest.fixture(scope="module")
def one_world(tmp_path_factory) -> Iterator[World]:
    world = World(tmp_path_factory.mktemp("bags") / "flight")
    yield world
    world.close()


@pytest.fixture
def world(one_world, request) -> Iterator[World]:
    """The same for all, which has to localize whatever has been done to it."""
    assert one_world.localizes()
    seen = len(one_world.said)
    yield one_world
    before = len(one_world.said)
    assert one_world.localizes(), one_world.said[before:]
    internal = [text for text in one_world.said[seen:] if text.startswith("internal_error")]
    assert len(internal) == (request.function is test_a_bug_in_the_node)


def hand_over(world: World, topic: str, message: Any) -> None:
    """Past DDS, which loses pieces of what is large, and what comes faster than it is taken."""
    world.node._inputs._subscriptions[topic].callback(message)


def test_a_million_points(world):
    """Of a frame's landmarks, in any order: of each one match counts."""
    table = np.random.default_rng(3).choice(world.table(), 1_000_000)
    before = len(world.answers["pose"])
    hand_over(world, "camera_info", world.camera_info)
    hand_over(world, "correspondences", world.cloud(table))
    world.wait(lambda: len(world.answers["pose"]) > before)


def test_a_frame_that_takes_long(world):
    """Diagnostics and parameters go on."""
    started, go_on = threading.Event(), threading.Event()
    frames = world.node._frames
    localize = frames.localize

    def wait(message: Any) -> Any:
        del frames.localize
        started.set()
        assert go_on.wait(TIMEOUT)
        return localize(message)

    frames.localize = wait
    while not started.wait(0.1):
        world.publishers["/correspondences"].publish(world.cloud())
    assert world.set("min_inliers", 13) == world.set("min_inliers", 12) == (True, "")
    world.diagnosis(r"WARN: a frame has been worked on for \d")
    go_on.set()


def test_a_bug_in_the_node(world):
    frames = world.node._frames

    def fail(message: Any) -> Any:
        del frames.localize
        raise TypeError("a bug")

    frames.localize = fail
    while "localize" in vars(frames):
        world.publishers["/correspondences"].publish(world.cloud())
        world.peer.spin_until(lambda: "localize" not in vars(frames), 0.5)
    world.wait(lambda: "internal_error: TypeError('a bug') in fail" in world.said[-1])


def test_simulated_time(world):
    """Without a clock time stands still at zero; with one it may run backwards."""
    assert world.set("use_sim_time", True) == (True, "")
    assert world.localizes()
    before = len(world.states)
    world.wait(lambda: len(world.states) >= before + 2)
    clock = world.peer.node.create_publisher(Clock, "/clock", 10)
    world.wait(clock.get_subscription_count)
    for second in (100, 50, 200):
        message = Clock()
        message.clock.sec = second
        clock.publish(message)
        now = world.node.get_clock().now
        world.wait(lambda now=now, second=second: now().nanoseconds == second * SECOND)
        assert world.localizes()
    world.peer.node.destroy_publisher(clock)
    assert world.set("use_sim_time", False) == (True, "")


def test_a_map_that_comes_late(world):
    """What all frames of the recording show, with a descriptor for each number."""

    def keypoints() -> Any:
        table = world.table()
        rows = np.zeros(len(table), [("u", "<f4"), ("v", "<f4"), ("descriptor", "u1", (32,))])
        rows["u"], rows["v"], rows["descriptor"] = table["u"], table["v"], DESCRIPTORS[table["id"]]
        world.stamp += SECOND // 30
        return make_cloud(make_message, world.stamp, "camera", rows)

    tables = [np.unique(world.table(k)[["id", "x", "y", "z"]]) for k in range(len(world.clouds))]
    table = np.unique(np.concatenate(tables))
    points = np.stack([table[name].astype(np.float64) for name in "xyz"], axis=1)
    shown = Map(points, table["id"].astype(np.int64), DESCRIPTORS[table["id"]], "map")
    assert not world.poses("/keypoints", keypoints(), within=0.3)
    world.publishers["/map_points"].publish(make_cloud(make_message, 0, "map", map_rows(shown)))
    world.wait(lambda: world.poses("/keypoints", keypoints(), within=0.3))


def test_the_camera_has_a_parent(world):
    """It hangs on something already."""
    before = len(world.said)
    item = TransformStamped(child_frame_id=world.camera_info.header.frame_id)
    item.header.frame_id = "camera_link"
    with tf2_ros() as tf2:
        hung = tf2.StaticTransformBroadcaster(world.peer.node)
        hung.sendTransform(item)
        assert world.set("publish_tf", "map_to_camera") == (True, "")
        said = re.compile("not_broadcast: .* already has parent")
        world.wait(lambda: world.localizes() and any(map(said.search, world.said[before:])))
        world.peer.node.destroy_publisher(hung.pub_tf)
    assert world.set("publish_tf", "none") == (True, "")
