# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The feature detector as its users meet it: its own process, real DDS, the bits of offline."""

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image, PointCloud2

from rs_localizer.cli.main import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, make_message, open_bag
from rs_localizer.io.recording import make_camera_info
from rs_localizer.ros.node.conversion import copy_message

RUN = "import sys; from rs_localizer.ros.main import feature_detector as f; sys.exit(f())"
CAMERA = Camera(320, 240, np.array([[400.0, 0.0, 159.5], [0.0, 400.0, 119.5], [0.0, 0.0, 1.0]]))
KIND = "sensor_msgs/msg/Image"


def image(second: int, **changes: Any) -> Any:
    """Spots; a picture of its own for every second."""
    noise = np.random.default_rng(second).integers(0, 256, (240, 320), np.uint8)
    pixels = cv2.GaussianBlur(noise, (0, 0), 2.0)
    stamp = make_message("builtin_interfaces/msg/Time", sec=second, nanosec=0)
    values = {
        "header": make_message("std_msgs/msg/Header", stamp=stamp, frame_id="eye"),
        "height": 240, "width": 320, "encoding": "mono8", "is_bigendian": 0, "step": 320,
        "data": pixels.ravel(),
    }  # fmt: skip
    return make_message(KIND, **(values | changes))


class Sender:
    """Publishes images, and hears what comes of them."""

    def __init__(self, peer: Any) -> None:
        self.peer = peer
        self.publisher = peer.node.create_publisher(Image, "/image", 1)
        self.heard: dict[str, list[Any]] = {}

    def listen(self, kind: type, topic: str) -> Any:
        kept = self.heard.setdefault(topic, [])
        return self.peer.node.create_subscription(kind, topic, kept.append, 10)

    def listeners(self, count: int) -> bool:
        return bool(self.peer.spin_until(lambda: self.publisher.get_subscription_count() == count))

    def send_until(self, message: Any, condition: Callable[[], bool]) -> None:
        copied = copy_message(message, KIND)
        for _ in range(30):
            self.publisher.publish(copied)
            if self.peer.spin_until(condition, 0.5):
                return
        raise AssertionError("nothing comes of the image")

    def ask(self, message: Any, topic: str = "/keypoints") -> Any:
        """What comes of an image."""

        def answers() -> list[Any]:
            heard = self.heard[topic]
            return [m for m in heard if m.header.stamp.sec == message.header.stamp.sec]

        self.send_until(message, lambda: bool(answers()))
        return answers()[0]


@pytest.fixture
def recording(tmp_path) -> Path:
    with BagWriter(tmp_path / "images") as bag:
        for second in range(5, 9):
            bag.write("/camera_info", make_camera_info(CAMERA, second * 10**9), second * 10**9)
            bag.write("/image", image(second), second * 10**9)
    return tmp_path / "images"


def test_images_become_keypoints(start_node, peer, recording, tmp_path):
    node = start_node("-p", "features:=orb", "-p", "max_keypoints:=200", run=RUN)
    camera = Sender(peer)
    node.wait_for_log("active with orb, at most 200 keypoints an image")
    # Lazy: nobody listens, so the camera has no listener either.
    peer.spin_until(lambda: False, 0.6)
    assert camera.publisher.get_subscription_count() == 0
    clouds = camera.listen(PointCloud2, "/keypoints")
    assert camera.listeners(1)

    # The same bits as offline, image by image.
    words = ["--features", "orb", "--max-keypoints", "200", "--out", str(tmp_path / "seen")]
    assert main(["detect", str(recording), *words]) == 0
    with open_bag(tmp_path / "seen") as bag:
        offline = [m for _, _, m in bag.messages(["/keypoints"])]
    assert len(offline) == 4
    for message in offline:
        live = camera.ask(image(message.header.stamp.sec))
        assert live == copy_message(message, "sensor_msgs/msg/PointCloud2")
        assert 100 < live.width <= 200
        assert live.header.frame_id == "eye"

    # Whatever comes, the next good image is answered.
    camera.send_until(image(20, encoding="32FC1"), lambda: "bad_image: the encoding" in node.log)
    assert camera.ask(image(21)).width > 100
    black = np.zeros(240 * 320, np.uint8)
    assert camera.ask(image(22, data=black)).width == 0

    # Another kind from now on; one that there is not is refused.
    def set_features(kind: str) -> Any:
        parameter = Parameter("features", value=kind).to_parameter_msg()
        request = SetParametersAtomically.Request(parameters=[parameter])
        name = "/feature_detector/set_parameters_atomically"
        return peer.call(SetParametersAtomically, name, request).result

    assert "must be one of sift, orb, akaze; got 'surf'" in set_features("surf").reason
    assert set_features("sift").successful
    descriptor = camera.ask(image(30)).fields[-1]
    assert (descriptor.name, descriptor.count) == ("descriptor", 128)

    # The debug picture has circles; the diagnostics tell of it all.
    camera.listen(Image, "/feature_detector/debug_image")
    camera.listen(DiagnosticArray, "/diagnostics")
    shown = camera.ask(image(31), "/feature_detector/debug_image")
    pixels = np.frombuffer(shown.data, np.uint8).reshape(240, 320, 3)
    assert (shown.encoding, np.any(pixels[..., 0] != pixels[..., 2])) == ("bgr8", True)

    def reported() -> bool:
        found = [s for m in camera.heard["/diagnostics"] for s in m.status]
        values = [{v.key: v.value for v in s.values} for s in found if "feature" in s.name]
        return any(v.get("Keypoints", "0") != "0" and "Refused: bad_image" in v for v in values)

    assert peer.spin_until(reported)
    for subscription in list(peer.node.subscriptions):
        if subscription is clouds or "debug" in subscription.topic_name:
            peer.node.destroy_subscription(subscription)
    assert camera.listeners(0)
    assert node.stop(signal.SIGINT) == 0
    assert "Traceback" not in node.log
