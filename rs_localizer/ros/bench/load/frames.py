"""Simulated frames of a hand-held camera as serialized messages, to be published for ever."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from rclpy.serialization import serialize_message

from rs_localizer import data
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.recording import CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC
from rs_localizer.io.trajectories import read_tum
from rs_localizer.lab.simulation.frames import FrameSettings, simulate_frames
from rs_localizer.lab.simulation.recording import write_simulated
from rs_localizer.lab.simulation.scene import room
from rs_localizer.lab.simulation.true_motion import RecordedMotion, sampled_way
from rs_localizer.ros.node.conversion import copy_message

READOUT_TIME = 0.02
"""s of the simulated camera."""

_K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
_D = np.array([-0.2, 0.05, 0.0, 0.0, 0.0])
# After these the motion starts over: a jump to which the tracker has to find again.
_DIFFERENT = 500
_FIRST_NS = 1_000_000_000
# A serialized message begins with four bytes of CDR, then with the stamp of its header.
_STAMP = slice(4, 12)


@dataclass(frozen=True, slots=True)
class Frames:
    """A camera_info and clouds, serialized; each time round they get new stamps."""

    rate: float  # Hz
    camera_info: bytes
    clouds: list[bytearray]

    def save(self, path: Path) -> None:
        """For another process, as an NPZ file."""
        np.savez(
            path,
            rate=self.rate,
            camera_info=np.frombuffer(self.camera_info, np.uint8),
            clouds=np.frombuffer(b"".join(self.clouds), np.uint8),
            ends=np.cumsum([len(cloud) for cloud in self.clouds]),
        )

    @classmethod
    def load(cls, path: Path) -> Self:
        with np.load(path, allow_pickle=False) as file:
            clouds = np.split(file["clouds"], file["ends"][:-1])
            return cls(
                float(file["rate"]),
                file["camera_info"].tobytes(),
                [bytearray(cloud.tobytes()) for cloud in clouds],
            )

    def cloud(self, index: int) -> bytes:
        """The cloud of the frame with this number; it never ends."""
        cloud = self.clouds[index % len(self.clouds)]
        seconds, nanoseconds = divmod(self.stamp_ns(index), 1_000_000_000)
        cloud[_STAMP] = np.array([seconds, nanoseconds], "<u4").tobytes()
        return bytes(cloud)

    def stamp_ns(self, index: int) -> int:
        return _FIRST_NS + round(index * 1e9 / self.rate)

    def index(self, serialized: bytes) -> int:
        """The number of the frame that a serialized message with its stamp belongs to."""
        seconds, nanoseconds = map(int, np.frombuffer(serialized[_STAMP], "<u4"))
        return round((seconds * 1_000_000_000 + nanoseconds - _FIRST_NS) * 1e-9 * self.rate)


def simulated(points: int, outliers: float, rate: float, different: int = _DIFFERENT) -> Frames:
    """Frames of a camera that is moved by hand through a room, so many before it starts over."""
    motion = RecordedMotion(read_tum(data.path(data.HAND_MOTION)))
    camera = Camera(640, 480, _K, _D, readout_time=READOUT_TIME)
    world = room(sampled_way(motion).positions, np.random.default_rng(0), count=20_000)
    start = motion.intervals_ns[0][0]
    stamps = [start + round(k * 1e9 / rate) for k in range(different)]
    settings = FrameSettings(points=points, noise=0.7, outliers=outliers, rate=rate)
    infos: list[bytearray] = []
    clouds: list[bytearray] = []
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "frames"
        with BagWriter(path) as bag:
            for frame in simulate_frames(camera, motion, world, settings, stamps_ns=stamps):
                write_simulated(bag, camera, frame)
        with open_bag(path) as recording:
            topics = (CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC)
            for topic, _, message in recording.messages(topics):
                serialized = serialize_message(copy_message(message, message.__msgtype__))
                (infos if topic == CAMERA_INFO_TOPIC else clouds).append(bytearray(serialized))
    return Frames(rate, bytes(infos[0]), clouds)
