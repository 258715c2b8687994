# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated frames of a hand-held camera as serialized messages, to be published for ever."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from rclpy.serialization import serialize_message

from benchmarks.hand_held import CAMERA, HandHeld
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.recording import CAMERA_FRAME, CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC
from rs_localizer.ros.node.conversion import copy_message
from rs_localizer.tools.simulation.recording import write_simulated

READOUT_TIME = CAMERA.readout_time
"""s of the simulated camera."""

# After these the motion starts over: a jump to which the tracker has to find again.
_DIFFERENT = 500
# Late enough for frames before the first one.
_FIRST_NS = 1_000_000_000_000
# A serialized message begins with four bytes of CDR, then with the stamp of its header.
_STAMP = slice(4, 12)


@dataclass(frozen=True, slots=True)
class Frames:
    """A camera_info and clouds, serialized; each time round they get new stamps."""

    rate: float  # Hz
    camera_info: bytes
    clouds: list[bytearray]
    imus: list[bytearray]  # readings of the same time; may be empty

    @property
    def imu_rate(self) -> float:
        """Hz."""
        return self.rate * len(self.imus) / len(self.clouds)

    def save(self, path: Path) -> None:
        """For another process, as an NPZ file."""
        np.savez(
            path,
            rate=self.rate,
            camera_info=np.frombuffer(self.camera_info, np.uint8),
            clouds=np.frombuffer(b"".join(self.clouds), np.uint8),
            ends=np.cumsum([len(cloud) for cloud in self.clouds]),
            imus=np.array([np.frombuffer(imu, np.uint8) for imu in self.imus]),
        )

    @classmethod
    def load(cls, path: Path) -> Self:
        with np.load(path, allow_pickle=False) as file:
            clouds = np.split(file["clouds"], file["ends"][:-1])
            return cls(
                float(file["rate"]),
                file["camera_info"].tobytes(),
                [bytearray(cloud.tobytes()) for cloud in clouds],
                [bytearray(imu.tobytes()) for imu in file["imus"]],
            )

    def cloud(self, index: int) -> bytes:
        """The cloud of the frame with this number; it never ends."""
        return _stamped(self.clouds[index % len(self.clouds)], self.stamp_ns(index))

    def imu(self, index: int) -> bytes:
        """The reading with this number, by the clock of the frames."""
        stamp_ns = _FIRST_NS + round(index * 1e9 / self.imu_rate)
        return _stamped(self.imus[index % len(self.imus)], stamp_ns)

    def stamp_ns(self, index: int) -> int:
        return _FIRST_NS + round(index * 1e9 / self.rate)

    def index(self, serialized: bytes) -> int:
        """The number of the frame that a serialized message with its stamp belongs to."""
        seconds, nanoseconds = map(int, np.frombuffer(serialized[_STAMP], "<u4"))
        return round((seconds * 1_000_000_000 + nanoseconds - _FIRST_NS) * 1e-9 * self.rate)


def simulated(
    points: int,
    outliers: float,
    rate: float,
    different: int = _DIFFERENT,
    imu_rate: float = 0.0,
) -> Frames:
    """Frames of a camera that is moved by hand through a room, so many before it starts over.

    With a rate (Hz) of its own there is an IMU, too, in the axes of the camera.
    """
    flight = HandHeld(points, outliers, rate, different)
    infos: list[bytearray] = []
    clouds: list[bytearray] = []
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "frames"
        with BagWriter(path) as bag:
            for frame in flight.simulate():
                write_simulated(bag, CAMERA, frame)
        with open_bag(path) as recording:
            topics = (CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC)
            for topic, _, message in recording.messages(topics):
                serialized = serialize_message(copy_message(message, message.__msgtype__))
                (infos if topic == CAMERA_INFO_TOPIC else clouds).append(bytearray(serialized))
    readings = flight.readings(imu_rate, CAMERA_FRAME) if imu_rate else ()
    imus = [
        bytearray(serialize_message(copy_message(message, message.__msgtype__)))
        for _, message in readings
    ]
    return Frames(rate, bytes(infos[0]), clouds, imus)


def _stamped(message: bytearray, stamp_ns: int) -> bytes:
    message[_STAMP] = np.array(divmod(stamp_ns, 1_000_000_000), "<u4").tobytes()
    return bytes(message)
