# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The feature detector as its users meet it: its own process, real DDS, the bits of offline."""

import signal
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import Image, PointCloud2

from rs_localizer.cli.commands import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, make_message, open_bag
from rs_localizer.io.messages import make_header
from rs_localizer.io.recording import make_camera_info
from rs_localizer.ros.node.conversion import copy_message

from .talk import Talk

RUN = "import sys; from rs_localizer.ros.main import feature_detector as f; sys.exit(f())"
CAMERA = Camera(320, 240, np.array([[400.0, 0.0, 159.5], [0.0, 400.0, 119.5], [0.0, 0.0, 1.0]]))
KIND = "sensor_msgs/msg/Image"


def image(second: int, **changes: Any) -> Any:
    """Spots; a picture of its own for every second."""
    noise = np.random.default_rng(second).integers(0, 256, (240, 320), np.uint8)
    pixels = cv2.GaussianBlur(noise, (0, 0), 2.0)
    values = {
        "header": make_header(make_message, second * 10**9, "eye"),
        "height": 240, "width": 320, "encoding": "mono8", "is_bigendian": 0, "step": 320,
        "data": pixels.ravel(),
    }  # fmt: skip
    return make_message(KIND, **(values | changes))


@pytest.fixture
def recording(tmp_path) -> Path:
    with BagWriter(tmp_path / "images") as bag:
        for second in range(5, 9):
            bag.write("/camera_info", make_camera_info(CAMERA, second * 10**9), second * 10**9)
            bag.write("/image", image(second), second * 10**9)
    return tmp_path / "images"


def test_images_become_keypoints(start_node, peer, recording, tmp_path):
    node = start_node("-p", "features:=orb", "-p", "max_keypoints:=200", run=RUN)
    talk = Talk(peer, "feature_detector")
    node.wait_for_log("active with orb, at most 200 keypoints an image")
    talk.listen(PointCloud2, "/keypoints")
    assert talk.listeners(1)

    def ask(second: int, topic: str = "/keypoints", **changes: Any) -> Any:
        return talk.ask(copy_message(image(second, **changes), KIND), topic)

    # The same bits as offline, image by image.
    words = ["--features", "orb", "--max-keypoints", "200", "--out", str(tmp_path / "seen")]
    assert main(["detect", str(recording), *words]) == 0
    with open_bag(tmp_path / "seen") as bag:
        offline = [m for _, _, m in bag.messages(["/keypoints"])]
    assert len(offline) == 4
    for message in offline:
        live = ask(message.header.stamp.sec)
        assert live == copy_message(message, "sensor_msgs/msg/PointCloud2")
        assert 100 < live.width <= 200
        assert live.header.frame_id == "eye"

    # Another kind from now on; one that there is not is refused.
    assert "must be one of sift, orb, akaze; got 'surf'" in talk.set("features", "surf")[1]
    assert talk.set("features", "sift")[0]
    descriptor = ask(30).fields[-1]
    assert (descriptor.name, descriptor.count) == ("descriptor", 128)

    # The debug picture has circles.
    talk.listen(Image, "/feature_detector/debug_image")
    shown = ask(31, "/feature_detector/debug_image")
    pixels = np.frombuffer(shown.data, np.uint8).reshape(240, 320, 3)
    assert (shown.encoding, np.any(pixels[..., 0] != pixels[..., 2])) == ("bgr8", True)
    assert node.stop(signal.SIGINT) == 0
    assert "Traceback" not in node.log
