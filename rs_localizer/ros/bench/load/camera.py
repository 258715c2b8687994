"""The process that publishes: as a camera does, at a steady rate and whatever becomes of it."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, PointCloud2

from rs_localizer.io.topics import CAMERA_INFO, CORRESPONDENCES
from rs_localizer.ros.bench.load.frames import Frames

_DISCOVERY_TIMEOUT = 60.0  # s


class Camera:
    """Publishes frames to one node."""

    def __init__(self, node: Node, namespace: str, frames: Frames) -> None:
        self._frames = frames
        self._infos = node.create_publisher(
            CameraInfo, f"{namespace}/{CAMERA_INFO}", qos_profile_sensor_data
        )
        self._clouds = node.create_publisher(
            PointCloud2, f"{namespace}/{CORRESPONDENCES}", qos_profile_sensor_data
        )

    def wait(self) -> None:
        """Until somebody listens."""
        deadline = time.monotonic() + _DISCOVERY_TIMEOUT
        while not (self._infos.get_subscription_count() and self._clouds.get_subscription_count()):
            if time.monotonic() > deadline:
                raise TimeoutError("the node was not found")
            time.sleep(0.05)
        time.sleep(0.5)  # the other side has to find this one, too

    def send(self, index: int) -> float:
        """Publish a frame and its camera_info: time.monotonic() between the two."""
        cloud = self._frames.cloud(index)
        self._infos.publish(self._frames.camera_info)
        now = time.monotonic()
        self._clouds.publish(cloud)
        return now


def publish(camera: Camera, frames: Frames, sent: Any) -> None:
    """Publish at the rate of the frames, and write down when: time.monotonic() of each."""
    start = time.monotonic()
    for index in range(len(sent)):
        while (left := start + index / frames.rate - time.monotonic()) > 0.0:
            time.sleep(left)
        sent[index] = camera.send(index)


def main(namespace: str, frames_file: str, sent_file: str) -> None:
    frames = Frames.load(Path(frames_file))
    sent = np.memmap(sent_file, np.float64, mode="r+")
    rclpy.init()
    node = rclpy.create_node("camera", namespace=namespace)
    camera = Camera(node, namespace, frames)
    camera.wait()
    publish(camera, frames, sent)


if __name__ == "__main__":
    main(*sys.argv[1:])
