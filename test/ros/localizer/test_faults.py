# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The fault matrix: what is wrong, what the node says of it, and that it localizes afterwards.

A fault is a row of :data:`FAULTS`.
"""

import array
import contextlib
import re
import resource
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
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
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
from rs_localizer.ros.node.statistics import Event

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

    def cloud(self, index: int = 0, **changes: Any) -> PointCloud2:
        """A good frame, later than the last, with fields changed."""
        message = changed(self.clouds[index], changes)
        if "header" not in changes:
            self.stamp += SECOND // 30
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(self.stamp, SECOND)
        return message

    def info(self, **changes: Any) -> CameraInfo:
        """A good camera_info with fields changed."""
        return changed(self.camera_info, changes)

    def table(self) -> np.ndarray:
        """The rows of a good frame."""
        return self.table_of(self.clouds[0])

    def table_of(self, cloud: PointCloud2) -> np.ndarray:
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

    def poses(self, *messages: Any, count: int = 1, within: float = PATIENCE) -> bool:
        """Send; whether so many poses come."""
        before = len(self.heard)
        self.send(*messages)
        return self.until(lambda: len(self.heard) >= before + count, within)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        client = self.peer.create_client(kind, f"rs_localizer/{name}")
        assert client.wait_for_service(PATIENCE)
        future = client.call_async(request)
        assert self.until(future.done)
        self.peer.destroy_client(client)
        return future.result()

    def set(self, **values: object) -> str:
        """Set parameters at once: the reason of a refusal, else nothing."""
        parameters = [
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]
        request = SetParametersAtomically.Request(parameters=parameters)
        return str(
            self.call(SetParametersAtomically, "set_parameters_atomically", request).result.reason
        )

    def change_state(self, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self.call(ChangeState, "change_state", request).success)

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


def changed(message: Any, changes: dict[str, Any]) -> Any:
    """A copy with other fields."""
    fields = {name: getattr(message, name) for name in message.get_fields_and_field_types()}
    return type(message)(**(fields | changes))


def info(**changes: Any) -> Callable[[World], Any]:
    return lambda world: [world.info(**changes)]


def cloud(**changes: Any) -> Callable[[World], Any]:
    return lambda world: [world.cloud(**changes)]


def rows(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[World], Any]:
    """A cloud whose table is changed."""
    return lambda world: [world.cloud_of(change(world.table()))]


def stamped(*seconds: float) -> Callable[[World], Any]:
    """Frames with these stamps, one after the other; each is to be localized."""

    def do(world: World) -> str:
        before = len(world.said)
        for second in seconds:
            message = world.cloud()
            world.stamp = round(second * 1e9)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(world.stamp, SECOND)
            # On a busy machine the pose of a frame before may come first.
            assert any(
                world.poses(message, within=1.0)
                and world.heard[-1].header.stamp == message.header.stamp
                for _ in range(20)
            )
        return "; ".join(world.said[before:])

    return do


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


def noise(count: int) -> Callable[[np.ndarray], np.ndarray]:
    def change(table: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(1)
        table = np.resize(table, count)
        table["u"], table["v"] = rng.uniform(0, 640, count), rng.uniform(0, 480, count)
        return table

    return change


def resized(world: World) -> Any:
    """The camera switches to twice the size, in the middle of the stream, and back."""
    assert world.poses(world.cloud())
    scale = np.array([2, 1, 2, 1, 2, 2, 1, 1, 1])
    offset = np.array([0, 0, 0.5, 0, 0, 0.5, 0, 0, 0])
    large = world.info(width=1280, height=960, k=scale * np.array(world.camera_info.k) + offset)
    table = world.table()
    for name in "uv":
        table[name] = 2.0 * table[name] + 0.5
    world.send(large)
    world.wait(lambda: world.node._localizer.calibration.width == 1280)
    return [world.cloud_of(table)]


def garbage(world: World) -> str:
    """Messages whose every field may be anything."""
    rng = np.random.default_rng(2)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    sizes = [0, 1, 2, 7, 100, 2**16, 2**31, 2**32 - 1]
    for number in range(500):
        if number % 4 == 0:
            good = world.camera_info
            changes: dict[str, Any] = {
                "width": int(rng.choice(sizes)),
                "k": rng.choice([0.0, 1.0, -1.0, 500.0, 1e300, np.nan, np.inf], 9),
                "d": rng.choice([0.0, 1.0, np.nan, -1e300], rng.integers(0, 15)),
                "distortion_model": str(rng.choice(["plumb_bob", "equidistant", "", "x\0y"])),
                "binning_x": int(rng.choice(sizes)),
            }
        else:
            good = world.clouds[0]
            changes = {
                name: int(rng.choice(sizes))
                for name in ("width", "height", "point_step", "row_step")
            } | {
                "is_bigendian": bool(rng.integers(2)),
                "data": rng.bytes(int(rng.integers(0, 3000))),
                "fields": [
                    PointField(
                        name=str(rng.choice([*"xyzuv", "score", "id", "", "\u00e4"])),
                        offset=int(rng.choice(sizes)),
                        datatype=int(rng.integers(0, 256)),
                        count=int(rng.choice(sizes)),
                    )
                    for _ in range(rng.integers(0, 9))
                ],
            }
        kept = {name: changes[name] for name in changes if rng.random() < 0.4}
        kinds = good.get_fields_and_field_types()
        message = type(good)(**({name: getattr(good, name) for name in kinds} | kept))
        if not kept:
            continue
        hand_over(world, "camera_info" if number % 4 == 0 else "correspondences", message)
        if number % 20 == 0:
            world.wait(lambda: not world.node.worker._frames)
    growth = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert growth < 50_000, f"{growth} kB more memory"
    assert "internal_error" not in world.node.refusals.counts
    return f"{sum(world.node.refusals.counts.values())} refused"


# What happens to a node while it works.


def burst(world: World) -> str:
    """Frames faster than they can be localized: each is answered or counted."""

    def total() -> Any:
        return world.node.statistics.summary().total

    before = total()
    for _ in range(300):
        world.send(world.cloud())

    def rest() -> int:
        now = total()
        done = now[Event.ANSWERED] + now[Event.REFUSED] + now[Event.REPLACED]
        return now[Event.RECEIVED] - done

    world.wait(lambda: total()[Event.RECEIVED] > before[Event.RECEIVED])
    world.until(lambda: False, 0.2)
    world.wait(lambda: rest() == 0)
    assert total()[Event.REPLACED] > before[Event.REPLACED]
    assert world.diagnosis("Frames replaced = [1-9]")
    return "replaced"


def slow(
    world: World, name: str = "localize", message: Callable[[World], Any] = World.cloud
) -> Callable[[], None]:
    """The next frame is worked on until the returned function is called."""
    started, go_on = threading.Event(), threading.Event()
    frames = world.node._localizer
    localize = getattr(frames, name)

    def wait(message: Any) -> Any:
        delattr(frames, name)
        started.set()
        assert go_on.wait(PATIENCE)
        return localize(message)

    setattr(frames, name, wait)
    while not started.wait(0.1):
        world.send(message(world))
    return go_on.set


def deactivated(world: World) -> str:
    """Deactivated while a frame is worked on: it is not published any more."""
    before, sent = len(world.heard), world.stamp
    go_on = slow(world)
    assert world.change_state(Transition.TRANSITION_DEACTIVATE)
    go_on()
    assert world.diagnosis("OK: the node is inactive: activate it")
    stamps = [pose.header.stamp for pose in world.heard[before:]]
    # Poses of earlier frames may still have been on their way.
    assert all(stamp.sec * SECOND + stamp.nanosec <= sent for stamp in stamps)
    assert world.change_state(Transition.TRANSITION_ACTIVATE)
    world.wait(world.connected)
    return "the node is inactive: activate it"


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


def map_message(world: World, frame: str = "map") -> Any:
    """What all frames of the recording show, with a descriptor for each number."""
    tables = [np.unique(world.table_of(cloud)[["id", "x", "y", "z"]]) for cloud in world.clouds]
    table = np.unique(np.concatenate(tables))
    points = np.stack([table[name].astype(np.float64) for name in "xyz"], axis=1)
    shown = Map(points, table["id"].astype(np.int64), DESCRIPTORS[table["id"]], frame)
    return "map_points", make_cloud(make_message, 0, frame, map_rows(shown))


def keypoints(world: World) -> Any:
    """Those of a good frame."""
    table = world.table()
    rows = np.zeros(len(table), [("u", "<f4"), ("v", "<f4"), ("descriptor", "u1", (32,))])
    rows["u"], rows["v"], rows["descriptor"] = table["u"], table["v"], DESCRIPTORS[table["id"]]
    world.stamp += SECOND // 30
    return "keypoints", make_cloud(make_message, world.stamp, "camera", rows)


def without_a_map(world: World) -> str:
    """Keypoints come, a map does not."""
    before = len(world.said)
    world.send(world.camera_info)
    world.wait(lambda: world.send(keypoints(world)) or len(world.said) > before)
    assert world.diagnosis("State = waiting for a map")
    return "; ".join(world.said[before:])


def late_map(world: World) -> str:
    assert not world.poses(keypoints(world), within=0.3)
    world.send(map_message(world))
    world.wait(lambda: world.poses(keypoints(world), within=0.3))
    return "localized since the map came"


def replaced_within_a_frame(world: World) -> str:
    """The frame that is worked on is answered by the old map, the next one by the new."""
    before = len(world.heard)
    go_on = slow(world, "localize_keypoints", keypoints)
    world.send(map_message(world, frame="hall"))
    world.wait(lambda: "map_points" in world.node.worker._updates)
    go_on()
    world.wait(lambda: len(world.heard) > before)
    assert world.heard[before].header.frame_id == "map"
    world.wait(lambda: world.poses(keypoints(world), within=0.3))
    assert world.heard[-1].header.frame_id == "hall"
    world.send(map_message(world))
    world.wait(
        lambda: (
            world.poses(keypoints(world), within=0.3) and world.heard[-1].header.frame_id == "map"
        )
    )
    return next(text for text in world.said if text.startswith("map_replaced"))


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
    # camera_info
    Fault("no camera_info", lambda world: [world.cloud()], "no_camera_info: no usable camera_info"),
    Fault("K of zeros", info(k=np.zeros(9)), r"bad_camera_info: .*K\[0\] is 0"),
    Fault("other image size in the middle", resized, "", pose=True),
    # Clouds that cannot be read, or hold no pose
    Fault("truncated", cloud(data=b"\0" * 100), "bad_cloud: the data are truncated"),
    Fault("2^62 points", cloud(width=2**31, height=2**31, row_step=2**32 - 1), "bad_cloud: "),
    Fault("empty", cloud(width=0, row_step=0, data=b""), "empty_cloud: the cloud has no points"),
    Fault("one point", rows(lambda table: table[:1]), "too_few_points: 1 usable points of 1"),
    Fault("wrong matches only", rows(noise(100)), "too_few_inliers"),
    # What is unusual and right
    Fault("a million points", many, "", pose=True),
    Fault("time jumps", stamped(0.0, 1e6, 5.0, 7e8, 6.0), "time_went_back", pose=True),
    # Overload and bugs
    Fault("500 garbage messages", garbage, "refused"),
    Fault("300 frames at once", burst, "replaced"),
    Fault("a frame that takes long", stuck, "worked on for"),
    Fault("a bug in the node", bug, r"internal_error: TypeError\('a bug'\) in fail"),
    # Life cycle and the graph
    Fault("deactivated within a frame", deactivated, "inactive"),
    Fault("simulated time, no clock", simulated_time, "diagnostics go on"),
    Fault("frames stop", silence, "no frame has come"),
    # Keypoints and maps
    Fault("keypoints without a map", without_a_map, "no_map: no usable map has come yet"),
    Fault("a map that comes late", late_map, "localized since the map came"),
    Fault("a map replaced within a frame", replaced_within_a_frame, "map_replaced: a map of"),
    # TF
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
