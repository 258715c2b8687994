# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated frames of a hand-held camera as serialized messages, and the process that publishes.

It does as a camera does, at a steady rate and whatever becomes of it.
"""

import pickle
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Imu, PointCloud2

from benchmarks.data import HAND_MOTION
from rs_localizer.core import camera as core
from rs_localizer.io.imu import make_reading
from rs_localizer.io.recording import CAMERA_FRAME, make_camera_info, make_correspondences
from rs_localizer.io.topics import CAMERA_INFO, CORRESPONDENCES, IMU, POSE
from rs_localizer.io.trajectories import read_tum
from rs_localizer.ros.node.conversion import copy_message
from rs_localizer.settings import NODE_NAME
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import FrameSettings, simulate_frames
from rs_localizer.tools.simulation.simulated_imu import ImuSettings, Lever, simulate_imu
from rs_localizer.tools.simulation.true_motion import RecordedMotion, sampled_states

_K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
READOUT_TIME = 0.02  # s
CAMERA = core.Camera(640, 480, _K, np.array([-0.2, 0.05, 0.0, 0.0, 0.0]), readout_time=READOUT_TIME)
_NOISE = 0.7  # px
_LANDMARKS = 20_000
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


def messages(points: int, outliers: float, rate: float, count: int) -> list[Any]:
    """Correspondences of a camera that a hand moves through a room (TUM VI room5), so many frames.

    Args:
        points: of each frame.
        outliers: share of them.
        rate: Hz.
    """
    motion = RecordedMotion(read_tum(HAND_MOTION))
    world = room(sampled_states(motion).positions, np.random.default_rng(0), count=_LANDMARKS)
    start = motion.intervals_ns[0][0]
    stamps = [start + round(k * 1e9 / rate) for k in range(count)]
    settings = FrameSettings(points, _NOISE, outliers, rate)
    frames = simulate_frames(CAMERA, motion, world, settings, stamps_ns=stamps, seed=0)
    return [make_correspondences(f.stamp_ns, f.points, f.pixels, f.ids) for f in frames]


def simulated(
    points: int, outliers: float, rate: float, different: int = _DIFFERENT, imu_rate: float = 0.0
) -> Frames:
    """Such frames, so many before they start over; with a rate (Hz) of its own there is an IMU."""
    clouds = map(_serialized, messages(points, outliers, rate, different))
    imus = map(_serialized, _readings(imu_rate, different / rate)) if imu_rate else ()
    info = bytes(_serialized(make_camera_info(CAMERA, 0)))
    return Frames(rate, info, list(clouds), list(imus))


def _readings(rate: float, seconds: float) -> list[Any]:
    """sensor_msgs/Imu of the same motion, in the axes of the camera."""
    motion = RecordedMotion(read_tum(HAND_MOTION))
    settings, lever = ImuSettings(rate=rate), Lever(np.eye(3), np.zeros(3))
    track = simulate_imu(motion, settings, lever, np.random.default_rng(0))
    first = int(np.searchsorted(track.times_ns, motion.intervals_ns[0][0]))
    return [
        make_reading(
            int(track.times_ns[i]), track.angular_velocities[i], track.specific_forces[i],
            CAMERA_FRAME, settings.variances,
        )
        for i in range(first, first + round(seconds * rate))
    ]  # fmt: skip


def _serialized(message: Any) -> bytearray:
    return bytearray(serialize_message(copy_message(message, message.__msgtype__)))


def _stamped(message: bytearray, stamp_ns: int) -> bytes:
    message[_STAMP] = np.array(divmod(stamp_ns, 1_000_000_000), "<u4").tobytes()
    return bytes(message)


# Until one of them is answered, frames before the first are sent so far apart, in s.
_PROBES, _PROBE_INTERVAL = 240, 0.25
# From the last row to the correspondences, as long as a driver and a detector take, in s. An IMU
# tells of a row at once.
_PROCESSING = 0.015


class Camera:
    """Publishes frames to one node."""

    def __init__(self, node: Node, namespace: str, frames: Frames) -> None:
        self._node, self._frames = node, frames
        self._pose_topic = f"{namespace}/{NODE_NAME}/{POSE}"
        self._infos = node.create_publisher(
            CameraInfo, f"{namespace}/{CAMERA_INFO}", qos_profile_sensor_data
        )
        self._clouds = node.create_publisher(
            PointCloud2, f"{namespace}/{CORRESPONDENCES}", qos_profile_sensor_data
        )
        self._imus = node.create_publisher(Imu, f"{namespace}/{IMU}", qos_profile_sensor_data)

    def wait(self) -> None:
        """Until a frame is answered: both sides have found each other.

        Raises:
            TimeoutError: when none is.
        """
        heard: list[bytes] = []
        listener = self._node.create_subscription(
            PoseStamped, self._pose_topic, heard.append, qos_profile_sensor_data, raw=True
        )
        try:
            for index in range(-_PROBES, 0):
                self.send(index)
                due = time.monotonic() + _PROBE_INTERVAL
                while (left := due - time.monotonic()) > 0.0:
                    rclpy.spin_once(self._node, timeout_sec=left)
                if heard:
                    return
        finally:
            self._node.destroy_subscription(listener)
        raise TimeoutError("the node was not found")

    def send(self, index: int) -> float:
        """Publish a frame and its camera_info: time.monotonic() between the two."""
        cloud = self._frames.cloud(index)
        self._infos.publish(self._frames.camera_info)
        now = time.monotonic()
        self._clouds.publish(cloud)
        return now

    def send_imu(self, index: int) -> None:
        """Publish a reading."""
        self._imus.publish(self._frames.imu(index))


def publish(camera: Camera, frames: Frames, sent: Any) -> None:
    """Publish at the rate of the frames, and write down when: time.monotonic() of each."""
    start = time.monotonic()
    reading = 0
    for index in range(len(sent)):
        due = index / frames.rate + READOUT_TIME + _PROCESSING
        while frames.imus and reading / frames.imu_rate <= due:
            _sleep_until(start + reading / frames.imu_rate)
            camera.send_imu(reading)
            reading += 1
        _sleep_until(start + due)
        sent[index] = camera.send(index)


def _sleep_until(when: float) -> None:
    while (left := when - time.monotonic()) > 0.0:
        time.sleep(left)


def main(namespace: str, frames_file: str, sent_file: str) -> None:
    frames = pickle.loads(Path(frames_file).read_bytes())  # our own
    sent = np.memmap(sent_file, np.float64, mode="r+")
    rclpy.init()
    node = rclpy.create_node("camera", namespace=namespace)
    camera = Camera(node, namespace, frames)
    camera.wait()
    publish(camera, frames, sent)


if __name__ == "__main__":
    main(*sys.argv[1:])
