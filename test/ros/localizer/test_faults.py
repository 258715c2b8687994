# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The fault matrix: what is wrong, what the node says of it, and that it localizes afterwards.

A fault is a row of :data:`FAULTS`: those that only a live node can have. What single messages
have wrong is tested in ``test/io`` and ``test/pipeline``, what a worker does with frames in
``test/ros/node``.
"""

import array
import contextlib
import re
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TransformStamped
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, PointCloud2, PointField

from benchmarks.simulation.keypoints import map_rows, random_descriptors
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.ros.localizer.node import LocalizerNode
from rs_localizer.ros.node.conversion import make_message
from rs_localizer.ros.node.managed import spin

from .robot import READOUT_TIME, inputs, record, tf2_ros

PATIENCE = 20.0  # s, of a machine that is busy
CLOSE = 0.05  # m: the poses are right
SECOND = 1_000_000_000
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
DESCRIPTORS = random_descriptors(5000, np.random.default_rng(9))  # of the landmarks, by number


class World:
    """A live node in a thread, a peer that talks to it over DDS, and what the node has said.

    Args:
        bag: to be written: a flight without noise.
    """

    def __init__(self, bag: Path) -> None:
        self.truth = record(bag, noise=0.0, outliers=0.0)  # positions, of the frames
        infos, self.clouds = zip(*inputs(bag), strict=True)
        self.camera_info = infos[0]
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = LocalizerNode(
            context=self.context, cli_args=["--ros-args", "-p", f"readout_time:={READOUT_TIME}"]
        )
        # Every single one, where the log leaves out repetitions.
        self.said: list[str] = []
        notice = self.node.refusals.notice
        self.node.refusals.notice = lambda *texts: (
            self.said.append(": ".join(texts)),
            notice(*texts),
        )
        assert self.node.trigger_configure().name == self.node.trigger_activate().name == "SUCCESS"
        self.peer = Node("peer", context=self.context)
        self.heard: list[PoseStamped] = []
        self.diagnoses: list[str] = []
        create = self.peer.create_publisher
        self._publishers = {
            "camera_info": create(CameraInfo, "camera_info", 10),
            "correspondences": create(PointCloud2, "correspondences", 10),
            "keypoints": create(PointCloud2, "keypoints", 10),
            "map_points": create(PointCloud2, "map_points", LATCHED),
        }
        self.peer.create_subscription(PoseStamped, "rs_localizer/pose", self.heard.append, 100)
        self.peer.create_subscription(DiagnosticArray, "/diagnostics", self._take, 10)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.peer)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=spin, args=(self.node, self._stopped.is_set))
        self._thread.start()
        self.stamp = SECOND
        self.wait(self.connected)

    # -- what faults need --------------------------------------------------------------------

    def cloud(self, **changes: Any) -> PointCloud2:
        """A good frame, later than the last, with fields changed."""
        good = self.clouds[0]
        fields = {name: getattr(good, name) for name in good.get_fields_and_field_types()}
        message = PointCloud2(**(fields | changes))
        self.stamp += SECOND // 30
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(self.stamp, SECOND)
        return message

    def table(self, index: int = 0) -> np.ndarray:
        """The rows of a good frame."""
        cloud = self.clouds[index]
        kinds = {PointField.FLOAT32: "<f4", PointField.UINT32: "<u4"}
        columns = [(item.name, kinds[item.datatype]) for item in cloud.fields]
        return np.frombuffer(bytes(cloud.data), columns).copy()

    def cloud_of(self, table: np.ndarray) -> PointCloud2:
        """A frame with these rows."""
        return self.cloud(
            width=len(table), row_step=table.nbytes, data=array.array("B", table.tobytes())
        )

    def connected(self) -> bool:
        counts = [each.get_subscription_count() for each in self._publishers.values()]
        return min(counts) > 0 and self.peer.count_publishers("rs_localizer/pose") > 0

    def send(self, *messages: Any) -> None:
        """Each a camera_info or correspondences, or a pair of a topic and its message."""
        for message in messages:
            if isinstance(message, tuple):
                topic, message = message
            else:
                topic = "camera_info" if isinstance(message, CameraInfo) else "correspondences"
            self._publishers[topic].publish(message)

    def poses(self, *messages: Any, within: float = PATIENCE) -> bool:
        """Send; whether a pose comes."""
        before = len(self.heard)
        self.send(*messages)
        return self.until(lambda: len(self.heard) > before, within)

    def set(self, **values: object) -> str:
        """Set parameters at once: the reason of a refusal, else nothing."""
        parameters = [
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]
        request = SetParametersAtomically.Request(parameters=parameters)
        name = "rs_localizer/set_parameters_atomically"
        client = self.peer.create_client(SetParametersAtomically, name)
        assert client.wait_for_service(PATIENCE)
        future = client.call_async(request)
        assert self.until(future.done)
        self.peer.destroy_client(client)
        return str(future.result().result.reason)

    def diagnosis(self, text: str) -> bool:
        """Whether this comes up in the diagnostics."""
        del self.diagnoses[:-1]
        return self.until(lambda: any(re.search(text, item) for item in self.diagnoses))

    def until(self, condition: Callable[[], Any], within: float = PATIENCE) -> bool:
        deadline = time.monotonic() + within
        while not condition():
            if time.monotonic() > deadline:
                return False
            self._executor.spin_once(timeout_sec=0.005)
        return True

    def wait(self, condition: Callable[[], Any]) -> None:
        assert self.until(condition)

    # ----------------------------------------------------------------------------------------

    def localizes(self) -> bool:
        """Whether a good frame is answered, and with the true position."""
        for _ in range(20):  # any of them may be lost while the node follows a publisher's quality
            if self.poses(self.camera_info, self.cloud(), within=1.0):
                found = self.heard[-1].pose.position
                error = np.array([found.x, found.y, found.z]) - self.truth[0]
                return bool(np.linalg.norm(error) < CLOSE)
        return False

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = [f"{item.key} = {item.value}" for item in status.values]
            level = ["OK", "WARN", "ERROR", "STALE"][status.level[0]]
            self.diagnoses.append("\n".join([f"{level}: {status.message}", *values]))

    def close(self) -> None:
        self._stopped.set()
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        self.peer.destroy_node()
        rclpy.shutdown(context=self.context)


def many(world: World) -> str:
    """A million points, each with its own noise.

    Noise that ten thousand share would be taken for acceleration: with so many no prior counts.
    """
    table = np.resize(world.table(), 1_000_000)
    rng = np.random.default_rng(3)
    for name in "uv":
        table[name] += rng.normal(0.0, 0.5, len(table))
    before = len(world.heard)
    hand_over(world, "camera_info", world.camera_info)
    hand_over(world, "correspondences", world.cloud_of(table))
    world.wait(lambda: len(world.heard) > before)
    return ""


def hand_over(world: World, topic: str, message: Any) -> None:
    """Past DDS, which loses pieces of what is large, and what comes faster than it is taken."""
    subscription = world.node._inputs._subscriptions[topic]
    subscription.callback(serialize_message(message) if subscription.raw else message)


# What happens to a node while it works.


def stuck(world: World) -> str:
    """Diagnostics and parameters go on while a frame takes long."""
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
    assert world.set(min_inliers=13) == ""
    assert world.set(min_inliers=12) == ""
    assert world.diagnosis(r"WARN: a frame has been worked on for \d")
    go_on.set()
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
    before = len(world.diagnoses)
    world.wait(lambda: len(world.diagnoses) >= before + 2)
    clock = world.peer.create_publisher(Clock, "/clock", 10)
    for second in (100, 50, 200):
        message = Clock()
        message.clock.sec = second
        world.wait(clock.get_subscription_count)
        clock.publish(message)
        world.wait(
            lambda second=second: world.node.get_clock().now().nanoseconds == second * SECOND
        )
        assert world.poses(world.cloud())
    world.peer.destroy_publisher(clock)
    assert world.set(use_sim_time=False) == ""
    return "diagnostics go on"


def silence(world: World) -> str:
    """No frame for some seconds, though there is a publisher."""
    assert world.diagnosis("STALE: no frame has come for [2-9] s; /correspondences: it has 1 pub")
    assert world.diagnosis("Topic /correspondences = silent for .*1 publisher, but no message")
    return "STALE: no frame has come"


def map_message(world: World) -> Any:
    """What all frames of the recording show, with a descriptor for each number."""
    tables = [np.unique(world.table(k)[["id", "x", "y", "z"]]) for k in range(len(world.clouds))]
    table = np.unique(np.concatenate(tables))
    points = np.stack([table[name].astype(np.float64) for name in "xyz"], axis=1)
    shown = Map(points, table["id"].astype(np.int64), DESCRIPTORS[table["id"]], "map")
    return "map_points", make_cloud(make_message, 0, "map", map_rows(shown))


def keypoints(world: World) -> Any:
    """Those of a good frame."""
    table = world.table()
    rows = np.zeros(len(table), [("u", "<f4"), ("v", "<f4"), ("descriptor", "u1", (32,))])
    rows["u"], rows["v"], rows["descriptor"] = table["u"], table["v"], DESCRIPTORS[table["id"]]
    world.stamp += SECOND // 30
    return "keypoints", make_cloud(make_message, world.stamp, "camera", rows)


def late_map(world: World) -> str:
    assert not world.poses(keypoints(world), within=0.3)
    world.send(map_message(world))
    world.wait(lambda: world.poses(keypoints(world), within=0.3))
    return "localized since the map came"


class Static:
    """Says on /tf_static where a frame is, as long as it is open."""

    def __init__(self, world: World, tf2: Any, parent: str, child: str, x: float) -> None:
        self._world = world
        item = TransformStamped(child_frame_id=child)
        item.header.frame_id, item.transform.translation.x = parent, x
        self._broadcaster = tf2.StaticTransformBroadcaster(world.peer)
        self._broadcaster.sendTransform(item)

    def close(self) -> None:
        self._world.peer.destroy_publisher(self._broadcaster.pub_tf)


def second_parent(world: World) -> str:
    """The camera hangs on something already."""
    before = len(world.said)
    with (
        tf2_ros() as tf2,
        contextlib.closing(
            Static(world, tf2, "camera_link", world.camera_info.header.frame_id, 0.0)
        ),
    ):
        assert world.set(publish_tf="map_to_camera") == ""
        world.wait(
            lambda: (
                world.localizes() and any("already has parent" in t for t in world.said[before:])
            )
        )
    assert world.set(publish_tf="none") == ""
    return "; ".join(world.said[before:])


@dataclass(frozen=True)
class Fault:
    """A row: what is done to the node, and a pattern of what it has to say.

    Messages that are returned are sent until the node has said it (best effort may lose one). A
    text that is returned is what the node has answered. With ``pose`` it is to be localized all
    the same.
    """

    name: str
    do: Callable[[World], Any]
    says: str
    pose: bool = False


FAULTS = [
    # Work
    Fault("a million points", many, "", pose=True),
    Fault("a frame that takes long", stuck, "worked on for"),
    Fault("a bug in the node", bug, r"internal_error: TypeError\('a bug'\) in fail"),
    # The graph
    Fault("simulated time, no clock", simulated_time, "diagnostics go on"),
    Fault("frames stop", silence, "no frame has come"),
    Fault("a map that comes late", late_map, "localized since the map came"),
    Fault("the camera has a parent", second_parent, "not_broadcast: .* has parent", pose=True),
]


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> Iterator[World]:
    """The faults share one."""
    world = World(tmp_path_factory.mktemp("bags") / "flight")
    yield world
    world.close()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_fault(world, fault):
    seen, poses = len(world.said), len(world.heard)
    result = fault.do(world)
    answers = [result] if isinstance(result, str) else []

    def done() -> bool:
        if fault.pose and len(world.heard) == poses:
            return False
        return any(re.search(fault.says, text) for text in ["", *answers, *world.said[seen:]])

    for _ in range(20):
        if not isinstance(result, str):
            world.send(*result)
        if world.until(done, PATIENCE if isinstance(result, str) else 2.0):
            break
    assert done(), world.said[seen:]
    before = len(world.said)
    assert world.localizes(), world.said[before:]
    internal = [text for text in world.said[seen:] if text.startswith("internal_error")]
    assert len(internal) == (fault.do is bug)
