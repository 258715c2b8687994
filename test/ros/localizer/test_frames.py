"""base_frame and publish_tf of the node in its own process, with tf2_ros or a stand-in for it."""

import importlib
import importlib.util
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, PointCloud2

from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, make_message, open_bag, typestore
from rs_localizer.io.outputs import TYPES
from rs_localizer.ros.node.conversion import copy_message, message_class
from rs_localizer.simulation.frames import FrameSettings, simulate_frames
from rs_localizer.simulation.recording import write_simulated
from rs_localizer.simulation.scene import room
from rs_localizer.simulation.true_motion import ConstantVelocity

STAND_IN = Path(__file__).parents[1] / "stand_in"
INSTALLED = importlib.util.find_spec("tf2_ros") is not None
ENVIRONMENT = {} if INSTALLED else {"PYTHONPATH": str(STAND_IN)}
READOUT_TIME = 0.03
START_NS = 10**12
SHUTTER = ("-p", f"readout_time:={READOUT_TIME}")
K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = "camera_optical_frame"
# Numbers that survive any arithmetic: a camera at the front that looks to the left.
MOUNTING = ("base_link", CAMERA, (0.5, 0.25, 0.875), (-0.5, -0.5, 0.5, 0.5), 0)
ODOMETRY = [
    ("odom", "base_link", (0.1 * i, 0.3, 0.0), (0.0, 0.0, 0.6, 0.8), START_NS + i * 20_000_000)
    for i in range(12)
]
Sample = tuple[str, str, tuple[float, ...], tuple[float, ...], int]


def stamped(make: Callable[..., Any], sample: Sample) -> Any:
    parent, child, (x, y, z), (qx, qy, qz, qw), stamp_ns = sample
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=make("std_msgs/msg/Header", stamp=stamp, frame_id=parent),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        ),
    )


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "flight"
    camera = Camera(640, 480, K, readout_time=READOUT_TIME)
    motion = ConstantVelocity(
        np.array([0.5, -1.0, 1.5]), np.array([0.5, 0.2, -0.3]), 0.3, start_ns=START_NS
    )
    world = room(np.zeros((1, 3)), np.random.default_rng(0), count=5000)
    settings = FrameSettings(points=100, noise=0.5, outliers=0.2)
    with BagWriter(path) as bag:
        for topic, sample in [("/tf_static", MOUNTING), *(("/tf", s) for s in ODOMETRY)]:
            transforms = [stamped(make_message, sample)]
            message = make_message("tf2_msgs/msg/TFMessage", transforms=transforms)
            bag.write(topic, message, START_NS)
        for frame in list(simulate_frames(camera, motion, world, settings))[:5]:
            write_simulated(bag, camera, frame)
    return path


class Robot:
    """Sends what the node needs, and keeps what it answers."""

    def __init__(self, peer: Any, tf2_ros: Any) -> None:
        self.peer, self._tf2_ros = peer, tf2_ros
        self.answers: dict[str, list[bytes]] = {name: [] for name in TYPES}
        for name, kind in TYPES.items():
            peer.node.create_subscription(
                message_class(kind),
                f"/rs_localizer/{name}",
                self.answers[name].append,
                QoSProfile(depth=50),
                raw=True,
            )
        self._infos = peer.node.create_publisher(CameraInfo, "/camera_info", 1)
        self._clouds = peer.node.create_publisher(PointCloud2, "/correspondences", 1)
        self._moving = tf2_ros.TransformBroadcaster(peer.node)
        self._static: list[Any] = []
        self.sent: list[TransformStamped] = []
        outer = self

        class Listener(tf2_ros.TransformListener):
            def callback(self, data: Any) -> None:
                super().callback(data)
                outer.sent += [t for t in data.transforms if t.header.frame_id == "map"]

        self.buffer = tf2_ros.Buffer()
        self.listener = Listener(self.buffer, peer.node)

    def send(self, sample: Sample) -> None:
        item = stamped(lambda kind, **fields: message_class(kind)(**fields), sample)
        if sample[-1]:
            self._moving.sendTransform(item)
            return
        # tf2_ros of Jazzy sends the first transform of a child for ever.
        self._static.append(self._tf2_ros.StaticTransformBroadcaster(self.peer.node))
        self._static[-1].sendTransform(item)

    def connect(self) -> None:
        publishers = (self._infos, self._clouds, self._moving.pub_tf)
        # The listener of this class hears the transforms, too.
        counts = (1, 1, 2)

        def connected() -> bool:
            return all(
                p.get_subscription_count() >= n for p, n in zip(publishers, counts, strict=True)
            ) and all(self.peer.node.count_publishers(f"/rs_localizer/{n}") for n in TYPES)

        assert self.peer.spin_until(connected), "the node was not found"
        self.peer.spin_until(lambda: False, 0.3)  # the other side has to find us, too

    def frame(self, pair: tuple[Any, Any], timeout: float = 1.0) -> bool:
        """Send a frame; whether the node has answered."""
        before = len(self.answers["inliers"])
        self._infos.publish(pair[0])
        self.peer.spin_until(lambda: False, 0.02)
        self._clouds.publish(pair[1])
        return bool(self.peer.spin_until(lambda: len(self.answers["inliers"]) > before, timeout))

    def localize(self, pair: tuple[Any, Any]) -> None:
        assert any(self.frame(pair) for _ in range(20)), "no answer"

    def position(self) -> list[float]:
        """Of the last pose."""
        last = typestore().deserialize_cdr(self.answers["pose"][-1], TYPES["pose"])
        return [last.pose.position.x, last.pose.position.y, last.pose.position.z]


@pytest.fixture
def robot(peer, monkeypatch) -> Iterator[Robot]:
    if not INSTALLED:
        monkeypatch.syspath_prepend(str(STAND_IN))
    result = Robot(peer, importlib.import_module("tf2_ros"))
    yield result
    result.listener.unregister()
    if not INSTALLED:
        del sys.modules["tf2_ros"]


def inputs(recording: Path) -> list[tuple[Any, Any]]:
    with open_bag(recording) as bag:
        found: dict[str, list[Any]] = {"/camera_info": [], "/correspondences": []}
        for topic, _, message in bag.messages(tuple(found)):
            found[topic].append(copy_message(message, message.__msgtype__))
    return list(zip(*found.values(), strict=True))


def nanoseconds(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def change(peer: Any, name: str, value: object) -> tuple[bool, str]:
    parameter = Parameter(name, value=value).to_parameter_msg()
    request = SetParameters.Request(parameters=[parameter])
    result = peer.call(SetParameters, "/rs_localizer/set_parameters", request).results[0]
    return result.successful, result.reason


def test_node_and_replay_say_the_same_of_the_base(recording, tmp_path, start_node, robot):
    settings = [*SHUTTER, "-p", "base_frame:=base_link", "-p", "publish_tf:=map_to_odom"]
    start_node(*settings, **ENVIRONMENT)
    robot.connect()
    for sample in (MOUNTING, *ODOMETRY):
        robot.send(sample)
        robot.peer.spin_until(lambda: False, 0.01)
    frames = inputs(recording)
    for pose_time in ("stamp", "mid_frame"):
        for answers in (*robot.answers.values(), robot.sent):
            answers.clear()
        assert change(robot.peer, "pose_time", pose_time) == (True, "")
        for pair in frames:
            robot.localize(pair)
        assert robot.peer.spin_until(lambda: len(robot.sent) >= len(frames))
        out = tmp_path / pose_time
        settings[-1] = f"pose_time:={pose_time}"
        arguments = [*settings, "-p", "publish_tf:=map_to_odom"]
        # In a process of its own: what other tests have compiled in this one may round differently.
        words = ["replay", str(recording), "--out", str(out), *arguments]
        subprocess.run(
            [sys.executable, "-m", "rs_localizer", *words], check=True, capture_output=True
        )
        with open_bag(out / "result") as bag:
            compare(bag, robot, len(frames))
    # TF has a way from the map to the camera now, at the last time of odometry.
    robot.buffer.lookup_transform("map", CAMERA, Time())


def compare(bag: Any, robot: Robot, count: int) -> None:
    """The replay's results and the node's."""
    for name, kind in TYPES.items():
        offline = {
            nanoseconds(m): bytes(typestore().serialize_cdr(m, kind))
            for _, _, m in bag.messages([f"/rs_localizer/{name}"])
        }
        received = [typestore().deserialize_cdr(d, kind) for d in robot.answers[name]]
        live = {nanoseconds(m): bytes(typestore().serialize_cdr(m, kind)) for m in received}
        assert len(offline) == count
        assert live == offline
    corrections = [m.transforms[0] for _, _, m in bag.messages(["/tf"])]
    assert len(corrections) == count
    sent = {nanoseconds(item): item for item in robot.sent}
    assert len(sent) == count
    for correction in corrections:
        item = sent[nanoseconds(correction)]
        assert (item.header.frame_id, item.child_frame_id) == ("map", "odom")
        for part, names in (("translation", "xyz"), ("rotation", "xyzw")):
            numbers = [
                [getattr(getattr(of.transform, part), n) for n in names]
                for of in (item, correction)
            ]
            # The same bits with tf2_ros; the stand-in calculates in its own way.
            assert np.allclose(*numbers, rtol=0.0, atol=0.0 if INSTALLED else 1e-12)


def test_a_mounting_that_comes_and_changes_and_moves(recording, start_node, robot):
    settings = ("-p", "base_frame:=base_link", "-p", "transform_tolerance:=10.0")
    node = start_node(*SHUTTER, *settings, **ENVIRONMENT)
    robot.connect()
    pair, *_, last = inputs(recording)
    missing = f"no_transform: from the camera '{CAMERA}' to base_frame 'base_link'"
    for _ in range(20):  # the first ones may be lost
        assert not robot.frame(pair, 0.5)
        if missing in node.log:
            break
    assert missing in node.log
    robot.send(MOUNTING)
    robot.localize(pair)
    before = np.array(robot.position())
    # Calibrated anew, 2 m farther forward on the base: the base is 2 m farther back.
    robot.send((*MOUNTING[:2], (2.5, 0.25, 0.875), *MOUNTING[3:]))
    robot.peer.spin_until(lambda: False, 0.2)
    robot.localize(pair)
    assert np.linalg.norm(np.array(robot.position()) - before) == pytest.approx(2.0, abs=0.01)
    # A camera on a head: the node waits for transforms as late as the frame, and goes on then.
    stamp_ns = nanoseconds(last[1])
    for milliseconds in (-60, -40):
        robot.send((*MOUNTING[:4], stamp_ns + milliseconds * 10**6))
    robot.peer.spin_until(lambda: False, 0.2)
    answers = len(robot.answers["inliers"])
    assert not robot.frame(last, 0.5)
    for milliseconds in (20, 40):
        robot.send((*MOUNTING[:4], stamp_ns + milliseconds * 10**6))
    assert robot.peer.spin_until(lambda: len(robot.answers["inliers"]) > answers)
    # It ends at once also while it waits.
    last[1].header.stamp.sec += 1
    assert not robot.frame(last, 0.3)
    started = time.monotonic()
    assert node.stop(signal.SIGTERM) == 0
    assert time.monotonic() - started < 5.0
