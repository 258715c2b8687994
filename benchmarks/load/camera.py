# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The process that publishes: as a camera does, at a steady rate and whatever becomes of it."""

from __future__ import annotations

import pickle
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Imu, PointCloud2

from benchmarks.load.frames import READOUT_TIME, Frames
from rs_localizer.io.topics import CAMERA_INFO, CORRESPONDENCES, IMU, POSE
from rs_localizer.settings import NODE_NAME

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
