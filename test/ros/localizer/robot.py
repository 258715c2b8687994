# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot around the localizer in its own process: what it sends, and what it hears of the node."""

import contextlib
import importlib
import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Imu, PointCloud2

from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, open_bag, typestore
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import TYPES
from rs_localizer.ros.node.conversion import copy_message, message_class
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import FrameSettings, simulate_frames
from rs_localizer.tools.simulation.simulated_recording import write_simulated
from rs_localizer.tools.simulation.true_motion import ConstantVelocity

READOUT_TIME = 0.03
SHUTTER = ("-p", f"readout_time:={READOUT_TIME}")
K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
KINDS = {"/camera_info": CameraInfo, "/correspondences": PointCloud2, "/imu": Imu}
STAND_IN = Path(__file__).parents[1] / "stand_in"
INSTALLED = importlib.util.find_spec("tf2_ros") is not None
# Of a node that needs TF.
ENVIRONMENT = {} if INSTALLED else {"PYTHONPATH": str(STAND_IN)}


@contextlib.contextmanager
def tf2_ros() -> Iterator[Any]:
    """tf2_ros, or its stand-in where it is not installed."""
    if not INSTALLED:
        sys.path.insert(0, str(STAND_IN))
    try:
        yield importlib.import_module("tf2_ros")
    finally:
        if not INSTALLED:
            sys.path.remove(str(STAND_IN))
            del sys.modules["tf2_ros"]


def record(
    path: Path, known: float = 1.0, noise: float = 0.7, outliers: float = 0.3
) -> list[np.ndarray]:
    """A flight, with a calibration that knows a part of the distortion; its true positions."""
    distortion = np.array([-0.2, 0.05, 0.0, 0.0, 0.0])
    camera = Camera(640, 480, K, distortion, readout_time=READOUT_TIME)
    motion = ConstantVelocity(
        np.array([0.5, -1.0, 1.5]), np.array([0.5, 0.2, -0.3]), 0.4, start_ns=10**9
    )
    world = room(np.zeros((1, 3)), np.random.default_rng(0), count=5000)
    settings = FrameSettings(points=100, noise=noise, outliers=outliers)
    frames = list(simulate_frames(camera, motion, world, settings))
    with BagWriter(path) as bag:
        for frame in frames:
            write_simulated(bag, replace(camera, D=known * distortion), frame)
    return [frame.first_row.positions[0] for frame in frames]


def inputs(recording: Path) -> list[tuple[Any, Any]]:
    """Pairs of camera_info and correspondences as rclpy's messages."""
    with open_bag(recording) as bag:
        found: dict[str, list[Any]] = {"/camera_info": [], "/correspondences": []}
        for topic, _, message in bag.messages(tuple(found)):
            found[topic].append(copy_message(message, message.__msgtype__))
    return list(zip(*found.values(), strict=True))


def replayed(recording: Path, out: Path, *words: str) -> dict[str, dict[int, bytes]]:
    """What replay says of a recording, by topic and stamp."""
    # In a process of its own: what other tests have compiled in this one may round differently.
    replay = ["replay", str(recording), "--out", str(out), *words]
    subprocess.run([sys.executable, "-m", "rs_localizer", *replay], check=True, capture_output=True)
    with open_bag(out / "result") as bag:
        return {
            name: serialized([m for _, _, m in bag.messages([f"/rs_localizer/{name}"])], kind)
            for name, kind in TYPES.items()
        }


def serialized(messages: list[Any], kind: str) -> dict[int, bytes]:
    """Messages by their stamps, through one serializer: DDS may pad differently."""
    return {stamp_ns(m): bytes(typestore().serialize_cdr(m, kind)) for m in messages}


# Diagnostics, once a second, after which a frame that they do not count was lost.
_SILENT = 3


class Robot:
    """Sends what the node needs, and keeps what it answers and says of itself."""

    def __init__(self, peer: Any, *topics: str, namespace: str = "") -> None:
        self.peer = peer
        self._node = f"{namespace}/rs_localizer"
        self.answers: dict[str, list[bytes]] = {name: [] for name in TYPES}
        self.frames_sent = 0  # frames, without those that were lost
        self.values: dict[str, str] = {}  # of the diagnostics
        self.states: list[str] = []  # by them: level and message
        self.odd: set[str] = set()  # what has ever been odd by them
        for name, kind in TYPES.items():
            peer.node.create_subscription(
                message_class(kind), f"{self._node}/{name}", self.answers[name].append,
                QoSProfile(depth=100), raw=True,
            )  # fmt: skip
        peer.node.create_subscription(DiagnosticArray, "/diagnostics", self._take_status, 10)
        self.publishers = {
            topic: peer.node.create_publisher(KINDS[topic], namespace + topic, 500)
            for topic in ("/camera_info", "/correspondences", *topics)
        }

    def _take_status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith(": localizer"):
                self.values = {item.key: item.value for item in status.values}
                level = ["OK", "WARN", "ERROR", "STALE"][status.level[0]]
                self.states.append(f"{level}: {status.message}")
                self.odd |= {name for name in self.values if name.startswith("Notice: ")}

    def connect(self) -> None:
        def connected() -> bool:
            count = self.peer.node.count_publishers
            heard = all(one.get_subscription_count() for one in self.publishers.values())
            return heard and all(count(f"{self._node}/{name}") for name in TYPES)

        assert self.peer.spin_until(connected), "the node was not found"
        self.peer.spin_until(lambda: False, 0.3)  # the other side has to find us, too

    def send(self, info: Any, cloud: Any) -> None:
        self.frames_sent += 1
        if info is not None:
            self.publishers["/camera_info"].publish(info)
            self.peer.spin_until(lambda: False, 0.02)
        self.publishers["/correspondences"].publish(cloud)

    def localize(self, info: Any, cloud: Any) -> None:
        """Send a frame until the node has answered.

        Again only when it has been lost, as the node's diagnostics say: the answer to a second copy
        would be heard as the next.
        """
        before = len(self.answers["inliers"])

        def answered() -> bool:
            return len(self.answers["inliers"]) > before

        while not answered():
            said = len(self.states)
            self.send(info, cloud)

            def lost() -> bool:
                return len(self.states) > said + _SILENT and self.received < self.frames_sent  # noqa: B023

            assert self.peer.spin_until(lambda: answered() or lost()), "no answer"
            self.frames_sent = self.frames_sent if answered() else self.received

    @property
    def received(self) -> int:
        return int(self.values.get("Frames received", 0))

    def answered(self, name: str) -> dict[int, bytes]:
        received = [typestore().deserialize_cdr(d, TYPES[name]) for d in self.answers[name]]
        return serialized(received, TYPES[name])

    def set(self, name: str, value: object) -> tuple[bool, str]:
        answer: tuple[bool, str] = self.peer.set(self._node, name, value)
        return answer
