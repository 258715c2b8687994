"""An IMU beside the camera, heard by a node in its own process: as offline, or as without it."""

import importlib
import importlib.util
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Imu, PointCloud2

from rs_localizer.cli.main import main as command_line
from rs_localizer.io.bags import open_bag, typestore
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import TYPES
from rs_localizer.ros.node.conversion import copy_message, message_class

STAND_IN = Path(__file__).parents[1] / "stand_in"
INSTALLED = importlib.util.find_spec("tf2_ros") is not None
ENVIRONMENT = {} if INSTALLED else {"PYTHONPATH": str(STAND_IN)}
SHUTTER = ("-p", "readout_time:=0.03")
# The node's inputs are best effort, and a busy machine loses messages: here, none may be lost.
RELIABLE = [
    word
    for topic in ("/imu", "/camera_info", "/correspondences")
    for word in ("-p", f"qos_overrides.{topic}.subscription.reliability:=reliable")
]
FRAMES = 30
Item = tuple[str, int, Any]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "flight"
    words = ("--trajectory", "tum_vi_room5", "--start", "20", "--duration", "1")
    seen = ("--points", "60", "--noise", "0.3", "--outliers", "0.1")
    assert command_line(["simulate", str(path), *words, *seen, "--imu"]) == 0
    return path


@pytest.fixture(scope="module")
def items(recording) -> list[Item]:
    with open_bag(recording) as bag:
        return [
            (topic, recorded_ns, copy_message(message, message.__msgtype__))
            for topic, recorded_ns, message in bag.messages(KINDS)
        ]


KINDS = {"/imu": Imu, "/camera_info": CameraInfo, "/correspondences": PointCloud2}


class Robot:
    """Sends what the node needs, and keeps what it answers and what it says of itself."""

    def __init__(self, peer: Any, tf2_ros: Any) -> None:
        self.peer = peer
        self.answers: dict[str, list[bytes]] = {name: [] for name in TYPES}
        self.values: dict[str, str] = {}
        self._sent = 0
        for name, kind in TYPES.items():
            peer.node.create_subscription(
                message_class(kind), f"/rs_localizer/{name}", self.answers[name].append,
                QoSProfile(depth=100), raw=True,
            )  # fmt: skip
        peer.node.create_subscription(DiagnosticArray, "/diagnostics", self._take_status, 10)
        self._publishers = {
            topic: peer.node.create_publisher(kind, topic, QoSProfile(depth=500))
            for topic, kind in KINDS.items()
        }
        self._static = tf2_ros.StaticTransformBroadcaster(peer.node)

    def _take_status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith(": localizer"):
                self.values = {item.key: item.value for item in status.values}

    def connect(self) -> None:
        def connected() -> bool:
            return all(p.get_subscription_count() for p in self._publishers.values()) and all(
                self.peer.node.count_publishers(f"/rs_localizer/{name}") for name in TYPES
            )

        assert self.peer.spin_until(connected), "the node was not found"
        self.peer.spin_until(lambda: False, 0.3)  # the other side has to find us, too

    def mount(self, recording: Path) -> None:
        with open_bag(recording) as bag:
            ((_, _, message),) = bag.messages(["/tf_static"])
        transform = message.transforms[0]
        self._static.sendTransform(copy_message(transform, "geometry_msgs/msg/TransformStamped"))

    def greet(self, items: list[Item], listens: bool = True) -> None:
        """The camera, and the first reading, at which the node begins to listen to TF, if it can.

        Until it does: it may still have been looking for us.
        """
        listening = False
        for _ in range(20 if listens else 1):
            for topic in ("/camera_info", "/imu"):
                self.send(next(item for item in items if item[0] == topic))
            listening = self.peer.spin_until(
                lambda: self.peer.node.count_subscribers("/tf_static"), 1.0
            )
            if listening:
                break
        assert listening == listens
        self.peer.spin_until(lambda: False, 1.0)

    def send(self, item: Item) -> None:
        self._publishers[item[0]].publish(item[2])
        self._sent += item[0] == "/correspondences"

    def wait_for_answers(self) -> None:
        """To all frames so far."""
        answered = self.answers["inliers"]
        assert self.peer.spin_until(lambda: len(answered) == self._sent, 20.0), (
            f"{len(answered)} of {self._sent} frames: {self.values}"
        )

    def play(self, items: list[Item], delay: Callable[[Item], float] = lambda item: 0.0) -> None:
        """Send what was recorded in its order, as if some had come so many seconds later.

        Frames come one by one: this machine may be busy, and the newest would win.
        """
        order = sorted((item[1] * 1e-9 + delay(item), i) for i, item in enumerate(items))
        for _, i in order:
            if items[i][0] == "/correspondences":
                self.wait_for_answers()
            self.send(items[i])
        self.wait_for_answers()

    def bytes_of(self, name: str) -> dict[int, bytes]:
        """What the node said on a topic, by stamp."""
        received = [typestore().deserialize_cdr(d, TYPES[name]) for d in self.answers[name]]
        return {stamp_ns(m): bytes(typestore().serialize_cdr(m, TYPES[name])) for m in received}


@pytest.fixture
def robot(peer, monkeypatch) -> Iterator[Robot]:
    if not INSTALLED:
        monkeypatch.syspath_prepend(str(STAND_IN))
    yield Robot(peer, importlib.import_module("tf2_ros"))
    if not INSTALLED:
        del sys.modules["tf2_ros"]


def at_frames(items: list[Item], late: float) -> list[list[Item]]:
    """What comes until each frame, where readings come so many seconds late."""
    parts: list[list[Item]] = [[]]
    order = sorted(items, key=lambda item: item[1] * 1e-9 + late * (item[0] == "/imu"))
    for item in order:
        parts[-1].append(item)
        if item[0] == "/correspondences":
            parts.append([])
    return parts


def offline(recording: Path, out: Path, *words: str) -> dict[str, dict[int, bytes]]:
    """What replay says of it, by topic and stamp."""
    # In a process of its own: what other tests have compiled in this one may round differently.
    replay = ["replay", str(recording), "--out", str(out), *SHUTTER, *words]
    subprocess.run([sys.executable, "-m", "rs_localizer", *replay], check=True, capture_output=True)
    with open_bag(out / "result") as bag:
        return {
            name: {
                stamp_ns(m): bytes(typestore().serialize_cdr(m, kind))
                for _, _, m in bag.messages([f"/rs_localizer/{name}"])
            }
            for name, kind in TYPES.items()
        }


def test_node_and_replay_say_the_same(recording, items, tmp_path, start_node, robot):
    start_node(*SHUTTER, *RELIABLE, "-p", "imu.wait:=1.0", **ENVIRONMENT)
    robot.connect()
    robot.mount(recording)
    robot.greet(items)
    robot.play(items)
    assert robot.peer.spin_until(lambda: "IMU" in robot.values)
    used = (robot.values["IMU"], robot.values["IMU used (share of the last frames)"])
    assert used == ("used", "100%"), robot.values
    both = offline(recording, tmp_path / "both")
    alone = offline(recording, tmp_path / "alone", "--no-imu")
    for name in TYPES:
        assert len(both[name]) == FRAMES
        assert robot.bytes_of(name) == both[name]
    assert both["twist"] != alone["twist"]
    assert float(robot.values["IMU rate (Hz)"]) == pytest.approx(400.0)
    assert re.match(r"(-?\d+\.\d+ ){3}\+- ", robot.values["IMU bias (deg/s, camera axes)"])
    assert re.match(r"-?\d+\.\d+ \+- ", robot.values["IMU time offset (ms)"])


def test_an_imu_that_is_late_is_not_waited_for(recording, items, tmp_path, start_node, robot):
    node = start_node(*SHUTTER, *RELIABLE, **ENVIRONMENT)
    robot.connect()
    robot.mount(recording)
    robot.greet(items)
    for part in at_frames(items, 0.1):
        robot.play(part)
    alone = offline(recording, tmp_path / "alone", "--no-imu")
    for name in TYPES:
        assert robot.bytes_of(name) == alone[name]
    node.wait_for_log("imu_late: the IMU is not used: IMU messages arrive later than imu.wait")
    assert robot.peer.spin_until(lambda: "IMU not used: imu_late" in robot.values)
    assert "older than the last row" in robot.values["IMU"]
    assert "imu.wait" in robot.values["Odd: imu"]
