"""The fault matrix: what is wrong, what the node says of it, and that it localizes afterwards.

A fault is a row of :data:`FAULTS`. The table is written to a file with

    RS_LOCALIZER_FAULTS=out/faults.md .venv/bin/python -m pytest test/ros/localizer/test_faults.py
"""

from __future__ import annotations

import array
import contextlib
import importlib
import importlib.util
import os
import re
import resource
import sys
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
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, PointCloud2, PointField
from std_msgs.msg import String
from std_srvs.srv import Trigger

from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.lab.simulation.frames import FrameSettings, simulate_frames
from rs_localizer.lab.simulation.landmarks import map_rows, random_descriptors
from rs_localizer.lab.simulation.recording import write_simulated
from rs_localizer.lab.simulation.scene import room
from rs_localizer.lab.simulation.true_motion import ConstantVelocity
from rs_localizer.ros.localizer.node import LocalizerNode
from rs_localizer.ros.node.conversion import copy_message, make_message
from rs_localizer.ros.node.run import spin

READOUT_TIME = 0.03
K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
PATIENCE = 20.0  # s, of a machine that is busy
CLOSE = 0.05  # m: the poses are right
SECOND = 1_000_000_000
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
DESCRIPTORS = random_descriptors(5000, np.random.default_rng(9))  # of the landmarks, by number


@dataclass(frozen=True)
class Recording:
    """Frames, the true position of each, and one camera_info for all."""

    info: CameraInfo
    clouds: list[PointCloud2]
    truth: list[np.ndarray]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("bags") / "flight"
    camera = Camera(640, 480, K, np.array([-0.2, 0.05, 0.0, 0.0, 0.0]), readout_time=READOUT_TIME)
    motion = ConstantVelocity(np.array([0.5, -1.0, 1.5]), np.array([0.5, 0.2, -0.3]), 0.4)
    world = room(np.zeros((1, 3)), np.random.default_rng(0), count=5000)
    frames = list(simulate_frames(camera, motion, world, FrameSettings(points=100, noise=0.7)))
    with BagWriter(path) as bag:
        for frame in frames:
            write_simulated(bag, camera, frame)
    found: dict[str, list[Any]] = {"/camera_info": [], "/correspondences": []}
    with open_bag(path) as bag:
        for topic, _, message in bag.messages(tuple(found)):
            found[topic].append(copy_message(message, message.__msgtype__))
    return Recording(
        info=found["/camera_info"][0],
        clouds=found["/correspondences"],
        truth=[frame.first_row.positions[0] for frame in frames],
    )


class World:
    """A live node in a thread, a peer that talks to it over DDS, and what the node has said."""

    def __init__(self, recording: Recording, *arguments: str, namespace: str = "") -> None:
        self.recording = recording
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = LocalizerNode(
            context=self.context,
            namespace=namespace,
            cli_args=["--ros-args", "-p", f"readout_time:={READOUT_TIME}", *arguments],
        )
        # Every single one, where the log leaves out repetitions.
        self.said: list[str] = []
        notice = self.node.refusals.notice
        self.node.refusals.notice = lambda *texts: (
            self.said.append(": ".join(texts)),
            notice(*texts),
        )
        assert self.node.trigger_configure().name == self.node.trigger_activate().name == "SUCCESS"
        self._stopped = threading.Event()
        self._threads = [threading.Thread(target=spin, args=(self.node, self._stopped.is_set))]
        self.peer = Peer(self.context, namespace)
        self._threads.append(threading.Thread(target=self._spin_peer))
        for thread in self._threads:
            thread.start()
        self.stamp = SECOND
        self.wait(self.peer.connected)

    # -- what faults need --------------------------------------------------------------------

    def cloud(self, index: int = 0, **changes: Any) -> PointCloud2:
        """A good frame, later than the last, with fields changed."""
        source = self.recording.clouds[index]
        fields = {name: getattr(source, name) for name in source.get_fields_and_field_types()}
        message = PointCloud2(**(fields | changes))
        if "header" not in changes:
            self.stamp += SECOND // 30
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(self.stamp, SECOND)
        return message

    def info(self, **changes: Any) -> CameraInfo:
        """A good camera_info with fields changed."""
        source = self.recording.info
        fields = {name: getattr(source, name) for name in source.get_fields_and_field_types()}
        return CameraInfo(**(fields | changes))

    def table(self) -> np.ndarray:
        """The rows of a good frame."""
        return self.table_of(self.recording.clouds[0])

    def table_of(self, cloud: PointCloud2) -> np.ndarray:
        kinds = {PointField.FLOAT32: "<f4", PointField.UINT32: "<u4"}
        columns = [(item.name, kinds[item.datatype]) for item in cloud.fields]
        return np.frombuffer(bytes(cloud.data), columns).copy()

    def cloud_of(self, table: np.ndarray) -> PointCloud2:
        """A frame with these rows."""
        return self.cloud(
            width=len(table), row_step=table.nbytes, data=array.array("B", table.tobytes())
        )

    def send(self, *messages: Any) -> None:
        for message in messages:
            self.peer.send(message)

    def poses(self, *messages: Any, count: int = 1, within: float = PATIENCE) -> bool:
        """Send; whether so many poses come."""
        before = len(self.peer.poses)
        self.send(*messages)
        return self.until(lambda: len(self.peer.poses) >= before + count, within)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        client = self.peer.node.create_client(kind, f"rs_localizer/{name}")
        assert client.wait_for_service(PATIENCE)
        future = client.call_async(request)
        assert self.until(future.done)
        self.peer.node.destroy_client(client)
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
        del self.peer.diagnoses[:-1]
        return self.until(lambda: any(re.search(text, item) for item in self.peer.diagnoses))

    def until(self, condition: Callable[[], Any], within: float = PATIENCE) -> bool:
        deadline = time.monotonic() + within
        while not condition():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.002)
        return True

    def wait(self, condition: Callable[[], Any]) -> None:
        assert self.until(condition)

    # ----------------------------------------------------------------------------------------

    def localizes(self) -> bool:
        """Whether a good frame is answered, and with the true position."""
        self.send(self.recording.info)
        for _ in range(20):  # sensor data may be lost
            if self.poses(self.cloud(), within=1.0):
                found = self.peer.poses[-1].pose.position
                error = np.array([found.x, found.y, found.z]) - self.recording.truth[0]
                return bool(np.linalg.norm(error) < CLOSE)
        return False

    def _spin_peer(self) -> None:
        executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        executor.add_node(self.peer.node)
        while not self._stopped.is_set():
            executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        self._stopped.set()
        for thread in self._threads:
            thread.join()
        self.node.destroy_node()
        self.peer.node.destroy_node()
        rclpy.shutdown(context=self.context)


class Peer:
    """Publishes as a camera does, and listens."""

    def __init__(self, context: Context, namespace: str) -> None:
        self.node = Node("peer", context=context, namespace=namespace)
        self.poses: list[PoseStamped] = []
        self.diagnoses: list[str] = []
        create = self.node.create_publisher
        self._publishers = {
            CameraInfo: create(CameraInfo, "camera_info", 10),
            PointCloud2: create(PointCloud2, "correspondences", 10),
        }
        self._others = {
            "keypoints": create(PointCloud2, "keypoints", 10),
            "map_points": create(PointCloud2, "map_points", LATCHED),
        }
        self.node.create_subscription(PoseStamped, "rs_localizer/pose", self.poses.append, 100)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._take, 10)

    def connected(self) -> bool:
        publishers = [*self._publishers.values(), *self._others.values()]
        counts = [publisher.get_subscription_count() for publisher in publishers]
        return min(counts) > 0 and self.node.count_publishers("rs_localizer/pose") > 0

    def send(self, message: Any) -> None:
        """A camera_info or correspondences, or a pair of another topic and its message."""
        if isinstance(message, tuple):
            topic, message = message
            self._others[topic].publish(message)
        else:
            self._publishers[type(message)].publish(message)

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = [f"{item.key} = {item.value}" for item in status.values]
            level = ["OK", "WARN", "ERROR", "STALE"][status.level[0]]
            self.diagnoses.append("\n".join([f"{level}: {status.message}", *values]))


@pytest.fixture(scope="module")
def world(recording: Recording) -> Iterator[World]:
    world = World(recording)
    yield world
    world.close()


# -- the rows --------------------------------------------------------------------------------


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


def info(**changes: Any) -> Callable[[World], Any]:
    return lambda world: [world.info(**changes)]


def cloud(**changes: Any) -> Callable[[World], Any]:
    return lambda world: [world.cloud(**changes)]


def fields(*change: Any, **attributes: Any) -> Callable[[World], Any]:
    """A cloud whose first fields are these, or the fifth one (v) with other attributes."""

    def do(world: World) -> Any:
        found = [
            PointField(name=i.name, offset=i.offset, datatype=i.datatype, count=i.count)
            for i in world.recording.clouds[0].fields
        ]
        for name, value in attributes.items():
            setattr(found[4], name, value)
        return [world.cloud(fields=[*change, *found])]

    return do


def rows(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[World], Any]:
    """A cloud whose table is changed."""
    return lambda world: [world.cloud_of(change(world.table()))]


def with_values(**columns: Any) -> Callable[[np.ndarray], np.ndarray]:
    def change(table: np.ndarray) -> np.ndarray:
        for name, value in columns.items():
            table[name] = value
        return table

    return change


def stamped(*seconds: float) -> Callable[[World], Any]:
    """Frames with these stamps, one after the other; each is to be localized."""

    def do(world: World) -> str:
        before = len(world.said)
        for second in seconds:
            message = world.cloud()
            world.stamp = round(second * 1e9)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(world.stamp, SECOND)
            assert any(world.poses(message, within=1.0) for _ in range(20))
            stamp = world.peer.poses[-1].header.stamp
            assert stamp == message.header.stamp
        return "; ".join(world.said[before:])

    return do


def big_endian(world: World) -> Any:
    table = world.table()
    swapped = table.astype(table.dtype.newbyteorder(">"))
    return [world.cloud(is_bigendian=True, data=swapped.tobytes())]


def many(world: World) -> str:
    """A million points, each with its own noise."""
    table = np.resize(world.table(), 1_000_000)
    rng = np.random.default_rng(3)
    for name in "uv":
        table[name] += rng.normal(0.0, 0.5, len(table))
    assert any(world.poses(world.cloud_of(table)) for _ in range(3))
    return ""


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
    large = world.info(width=1280, height=960, k=scale * np.array(world.recording.info.k) + offset)
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
    source = world.recording
    for number in range(10_000):
        if number % 4 == 0:
            good = source.info
            changes: dict[str, Any] = {
                "width": int(rng.choice(sizes)),
                "height": int(rng.choice(sizes)),
                "k": rng.choice([0.0, 1.0, -1.0, 500.0, 1e300, np.nan, np.inf], 9),
                "d": rng.choice([0.0, 1.0, np.nan, -1e300], rng.integers(0, 15)),
                "distortion_model": str(rng.choice(["plumb_bob", "equidistant", "", "x\0y"])),
                "binning_x": int(rng.choice(sizes)),
            }
        else:
            good = source.clouds[0]
            changes = {
                "width": int(rng.choice(sizes)),
                "height": int(rng.choice(sizes)),
                "point_step": int(rng.choice(sizes)),
                "row_step": int(rng.choice(sizes)),
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
        # Past DDS, which drops what comes faster than the node takes it.
        topic = "camera_info" if number % 4 == 0 else "correspondences"
        subscription = world.node._inputs._subscriptions[topic]
        subscription.callback(serialize_message(message) if subscription.raw else message)
        if number % 20 == 0:
            world.wait(lambda: not world.node.worker._mailbox._frames)
    growth = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert growth < 50_000, f"{growth} kB more memory"
    assert "internal_error" not in world.node.refusals.counts
    return f"{sum(world.node.refusals.counts.values())} refused"


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
    before = len(world.peer.poses)
    go_on = slow(world)
    assert world.change_state(Transition.TRANSITION_DEACTIVATE)
    go_on()
    assert world.diagnosis("OK: the node is inactive: activate it")
    assert len(world.peer.poses) == before
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


@contextlib.contextmanager
def tf2_ros() -> Iterator[Any]:
    """tf2_ros, or its stand-in where it is not installed."""
    installed = importlib.util.find_spec("tf2_ros") is not None
    if not installed:
        sys.path.insert(0, str(Path(__file__).parents[1] / "stand_in"))
    try:
        yield importlib.import_module("tf2_ros")
    finally:
        if not installed:
            sys.path.pop(0)
            del sys.modules["tf2_ros"]


def without_tf2_ros(world: World) -> str:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "tf2_ros", None)
        return world.set(publish_tf="map_to_odom")


def without_odometry(world: World) -> str:
    """The pose is published, its transform is not."""
    before = len(world.said)
    with tf2_ros():
        assert world.set(publish_tf="map_to_odom") == ""
        assert world.localizes()
    assert world.set(publish_tf="none") == ""
    return "; ".join(world.said[before:])


class Static:
    """Says on /tf_static where a frame is, as long as it is open."""

    def __init__(self, world: World, tf2: Any, parent: str, child: str, x: float) -> None:
        self._world = world
        item = TransformStamped(child_frame_id=child)
        item.header.frame_id, item.transform.translation.x = parent, x
        self._broadcaster = tf2.StaticTransformBroadcaster(world.peer.node)
        self._broadcaster.sendTransform(item)

    def close(self) -> None:
        self._world.peer.node.destroy_publisher(self._broadcaster.pub_tf)


def second_parent(world: World) -> str:
    """The camera hangs on something already."""
    before = len(world.said)
    with (
        tf2_ros() as tf2,
        contextlib.closing(
            Static(world, tf2, "camera_link", world.recording.info.header.frame_id, 0.0)
        ),
    ):
        assert world.set(publish_tf="map_to_camera") == ""
        world.wait(lambda: world.localizes() and any("hangs on" in t for t in world.said[before:]))
    assert world.set(publish_tf="none") == ""
    return "; ".join(world.said[before:])


def mounting(world: World) -> str:
    """A node for a body whose camera is nowhere, then at its origin, then 2 m ahead of it."""
    camera = world.recording.info.header.frame_id
    with tf2_ros() as tf2:
        other = World(world.recording, "-p", "base_frame:=body", namespace="/other")
        try:
            other.send(other.info())
            assert not other.poses(other.cloud(), within=0.5)
            other.wait(lambda: other.poses(other.cloud(), within=0.2) or other.said)
            answer = other.said[-1]
            with contextlib.closing(Static(world, tf2, "body", camera, 0.0)):
                other.wait(other.localizes)
            with contextlib.closing(Static(world, tf2, "body", camera, 2.0)):
                other.wait(lambda: not other.localizes())
                assert other.poses(other.cloud())
                found = other.peer.poses[-1].pose.position
                error = np.array([found.x, found.y, found.z]) - world.recording.truth[0]
                assert abs(np.linalg.norm(error) - 2.0) < CLOSE
        finally:
            other.close()
    return str(answer)


# -- keypoints and maps ----------------------------------------------------------------------


def landmarks(world: World, frame: str = "map") -> Map:
    """What all frames of the recording show, with a descriptor for each number."""
    tables = [
        np.unique(world.table_of(cloud)[["id", "x", "y", "z"]]) for cloud in world.recording.clouds
    ]
    table = np.unique(np.concatenate(tables))
    points = np.stack([table[name].astype(np.float64) for name in "xyz"], axis=1)
    return Map(points, table["id"].astype(np.int64), DESCRIPTORS[table["id"]], frame)


def map_message(
    world: World, change: Callable[[np.ndarray], np.ndarray] = lambda rows: rows, frame: str = "map"
) -> Any:
    rows = change(map_rows(landmarks(world, frame)))
    return "map_points", make_cloud(make_message, 0, frame, rows)


def keypoints(world: World, count: int = 0, **columns: np.ndarray) -> Any:
    """Those of a good frame, with other marks; repeated up to a count."""
    table = world.table()
    marks = columns or {"descriptor": DESCRIPTORS[table["id"]]}
    kinds = [("u", "<f4"), ("v", "<f4")]
    kinds += [(name, mark.dtype, mark.shape[1:]) for name, mark in marks.items()]
    rows = np.zeros(len(table), kinds)
    for name, values in {"u": table["u"], "v": table["v"], **marks}.items():
        rows[name] = values
    rows = np.resize(rows, count or len(rows))
    world.stamp += SECOND // 30
    return "keypoints", make_cloud(make_message, world.stamp, "camera", rows)


def marked(**columns: Any) -> Callable[[World], Any]:
    """Keypoints with these marks, made of the ids of a good frame."""
    return lambda world: [
        keypoints(world, **{name: mark(world.table()["id"]) for name, mark in columns.items()})
    ]


def mapped(change: Callable[[np.ndarray], np.ndarray], **attributes: Any) -> Callable[[World], Any]:
    def do(world: World) -> Any:
        topic, message = map_message(world, change)
        for name, value in attributes.items():
            setattr(message, name, value)
        return [(topic, message)]

    return do


def without_a_map(world: World) -> str:
    """Keypoints come, a map does not."""
    before = len(world.said)
    world.send(world.recording.info)
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
    frames = world.node._localizer
    localize = frames.localize_keypoints
    started, go_on = threading.Event(), threading.Event()

    def wait(message: Any) -> Any:
        del frames.localize_keypoints
        started.set()
        assert go_on.wait(PATIENCE)
        return localize(message)

    frames.localize_keypoints = wait
    before = len(world.peer.poses)
    world.wait(lambda: world.send(keypoints(world)) or started.wait(0.1))
    world.send(map_message(world, frame="hall"))
    world.wait(lambda: "map_points" in world.node.worker._mailbox._updates)
    go_on.set()
    world.wait(lambda: len(world.peer.poses) > before)
    assert world.peer.poses[before].header.frame_id == "map"
    world.wait(lambda: world.poses(keypoints(world), within=0.3))
    assert world.peer.poses[-1].header.frame_id == "hall"
    world.send(map_message(world))
    world.wait(
        lambda: (
            world.poses(keypoints(world), within=0.3)
            and world.peer.poses[-1].header.frame_id == "map"
        )
    )
    return next(text for text in world.said if text.startswith("map_replaced"))


def repeated(rows: np.ndarray) -> np.ndarray:
    rows["id"][1] = rows["id"][0]
    return rows


RELIABLE = ("-p", "qos_overrides./other/correspondences.subscription.reliability:=reliable")

FAULTS = [
    # camera_info
    Fault("no camera_info", lambda world: [world.cloud()], "no_camera_info: no usable camera_info"),
    Fault("K of zeros", info(k=np.zeros(9)), r"bad_camera_info: .*K\[0\] is 0"),
    Fault("K with NaN", info(k=np.full(9, np.nan)), "bad_camera_info: .*nan"),
    Fault("image of 0 x 0", info(width=0, height=0), "bad_camera_info: the image size"),
    Fault("unknown lens", info(distortion_model="fisheye9"), "bad_camera_info: distortion_model"),
    Fault("three coefficients", info(d=[0.1, 0.2, 0.3]), "bad_camera_info: .*3"),
    Fault(
        "camera without a frame",
        lambda world: [world.info(header=type(world.recording.info.header)())],
        "bad_camera_info: header.frame_id is empty",
    ),
    Fault("binning 2^32 - 1", info(binning_x=2**32 - 1), "bad_camera_info: binning of 4294967295"),
    Fault("other image size in the middle", resized, "", pose=True),
    # Clouds that cannot be read
    Fault("no field v", fields(name="w"), "bad_cloud: the cloud has no field v"),
    Fault("v as INT16", fields(datatype=3), "bad_cloud: field 'v' must be one of FLOAT32"),
    Fault("unknown type", fields(datatype=200), "bad_cloud: .*unknown type 200"),
    Fault("v thrice", fields(count=3), "bad_cloud: field 'v' must hold one value, found 3"),
    Fault("v beyond the row", fields(offset=2**32 - 1), "bad_cloud: point_step is 24, but"),
    Fault("two fields x", fields(PointField(name="x", datatype=7, count=1)), "has 2 fields 'x'"),
    Fault("truncated", cloud(data=b"\0" * 100), "bad_cloud: the data are truncated"),
    Fault("width 2^31", cloud(width=2**31), "bad_cloud: the data are truncated"),
    Fault("2^62 points", cloud(width=2**31, height=2**31, row_step=2**32 - 1), "bad_cloud: "),
    Fault("point_step 0", cloud(point_step=0), "bad_cloud: point_step is 0"),
    Fault("row_step 1", cloud(height=2, row_step=1), "bad_cloud: row_step is 1, too small"),
    Fault(
        "cloud without a frame",
        lambda world: [world.cloud(header=type(world.recording.info.header)())],
        "bad_cloud: header.frame_id is empty",
    ),
    Fault("empty", cloud(width=0, row_step=0, data=b""), "empty_cloud: the cloud has no points"),
    # Clouds that hold no pose
    Fault("one point", rows(lambda table: table[:1]), "too_few_points: 1 usable points of 1"),
    Fault("all NaN", rows(with_values(x=np.nan)), "too_few_points: 0 usable"),
    Fault("points at infinity", rows(with_values(x=1e30, y=-1e30)), "too_few_|no_"),
    Fault("the same point always", rows(lambda t: np.repeat(t[:1], 100)), "too_few|degenerate|no_"),
    Fault("wrong matches only", rows(noise(100)), "too_few_inliers"),
    # What is unusual and right
    Fault("big-endian", big_endian, "", pose=True),
    Fault("a million points", many, "", pose=True),
    Fault("stamp zero", stamped(0.0), "time_went_back", pose=True),
    Fault("time jumps forth and back", stamped(1e6, 5.0, 7e8, 6.0), "time_went_back", pose=True),
    Fault("a stamp before 1970", stamped(-7.5), "time_went_back", pose=True),
    Fault("the same stamp twice", stamped(10.0, 10.0), "", pose=True),
    # Overload and bugs
    Fault("10,000 garbage messages", garbage, "refused"),
    Fault("300 frames at once", burst, "replaced"),
    Fault("a frame that takes long", stuck, "worked on for"),
    Fault("a bug in the node", bug, r"internal_error: TypeError\('a bug'\) in fail"),
    # Parameters
    Fault("unknown solver", setting(solver="p4p"), "solver must be one of p3p"),
    Fault("inlier_threshold -1", setting(inlier_threshold=-1.0), "out of range"),
    Fault("seed as text", setting(seed="zero"), "type"),
    Fault("autostart while running", setting(autostart=False), "read-only"),
    Fault("no such parameter", setting(min_inlier=9), "undeclared"),
    Fault("one good, one bad", setting(min_inliers=20, solver="p4p"), "solver must be one of"),
    # Life cycle and services
    Fault("activate twice", impossible(Transition.TRANSITION_ACTIVATE), "false"),
    Fault("transition 99", impossible(99), "false"),
    Fault("deactivated within a frame", deactivated, "inactive"),
    Fault("cleaned up within a frame", cleaned_up, "waiting for camera_info"),
    Fault("reset within a frame", reset, "the previous pose and twist are forgotten"),
    # The graph
    Fault("simulated time, no clock", simulated_time, "diagnostics go on"),
    Fault("frames stop", silence, "no frame has come"),
    Fault(
        "two nodes in one process; QoS that does not fit",
        second_node(RELIABLE, PointCloud2, qos_profile_sensor_data),
        "the QoS of /other/driver does not fit: Best effort publisher and reliable subscription",
    ),
    Fault(
        "two nodes in one process; another type on the topic",
        second_node((), String, 10),
        "/other/driver publishes std_msgs/msg/String, not sensor_msgs/msg/PointCloud2",
    ),
    # Keypoints and maps
    Fault("keypoints without a map", without_a_map, "no_map: no usable map has come yet"),
    Fault("a map of 2^31 landmarks", mapped(lambda t: t, width=2**31), "bad_map: .*truncated"),
    Fault("a map with an id twice", mapped(repeated), "bad_map: 1 ids stand for several"),
    Fault("a map of NaN", mapped(with_values(x=np.nan)), "bad_map: the map has no landmarks"),
    Fault("a map of points only", mapped(lambda t: t[[*"xyz"]].copy()), "bad_map: .*neither"),
    Fault("a map that comes late", late_map, "localized since the map came"),
    Fault("a map replaced within a frame", replaced_within_a_frame, "map_replaced: a map of"),
    Fault(
        "descriptors of another width",
        marked(descriptor=lambda ids: np.zeros((len(ids), 64), np.uint8)),
        "bad_keypoints: the keypoints have descriptors of 64 x uint8, the map has .*32 x uint8",
    ),
    Fault(
        "descriptors of another kind",
        marked(descriptor=lambda ids: np.zeros((len(ids), 32), np.float32)),
        "bad_keypoints: the keypoints have descriptors of 32 x float32",
    ),
    Fault(
        "descriptors as INT16",
        marked(descriptor=lambda ids: np.zeros((len(ids), 32), np.int16)),
        "bad_keypoints: field 'descriptor' must be one of UINT8, FLOAT32; found INT16",
    ),
    Fault(
        "keypoints without marks",
        marked(size=lambda ids: np.zeros(len(ids), np.float32)),
        "bad_keypoints: the cloud has neither a field id nor descriptor",
    ),
    Fault("unknown ids only", marked(id=lambda ids: ids + 10**6), "no_matches: none of"),
    Fault(
        "100,000 keypoints",
        lambda world: [keypoints(world, 100_000)],
        "too_many_keypoints: 100000 keypoints",
        pose=True,
    ),
    # TF
    Fault("tf2_ros is not installed", without_tf2_ros, "needs the Python package tf2_ros"),
    Fault("map_to_odom without odometry", without_odometry, "not_broadcast: .*", pose=True),
    Fault("the camera has a parent", second_parent, "not_broadcast: .* hangs on", pose=True),
    Fault("the mounting is missing, then changes", mounting, "no_transform: from the camera"),
]


@pytest.fixture(scope="module")
def matrix() -> Iterator[list[tuple[str, str, str]]]:
    """The rows of the table: fault, what the node said, whether it localized afterwards."""
    found: list[tuple[str, str, str]] = []
    yield found
    if path := os.environ.get("RS_LOCALIZER_FAULTS"):
        lines = ["| fault | the node | localized afterwards |", "|---|---|---|"]
        lines += [f"| {name} | {said} | {after} |" for name, said, after in found]
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_fault(world: World, matrix: list[tuple[str, str, str]], fault: Fault) -> None:
    seen, poses = len(world.said), len(world.peer.poses)
    result = fault.do(world)
    answers = [result] if isinstance(result, str) else []

    def spoken() -> str:
        found = [text for text in [*answers, *world.said[seen:]] if re.search(fault.says, text)]
        return found[0] if found else ""

    def done() -> bool:
        if fault.pose and len(world.peer.poses) == poses:
            return False
        return bool(spoken()) or not fault.says

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
    said = next((line for line in spoken().splitlines() if re.search(fault.says, line)), "")
    row = f"localizes it; {said}" if fault.pose else said or "refuses it"
    matrix.append((fault.name, row.removesuffix("; "), "yes"))


def test_the_matrix_is_large_enough() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 30
