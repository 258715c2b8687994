# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The marker detector as its users meet it: its own process, real DDS, images of all kinds."""

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from rs_localizer.config import DetectorConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io.recording import make_camera_info
from rs_localizer.markers.dictionaries import pattern
from rs_localizer.markers.map_files import write_marker_map
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.pipeline.images import FrameDetector, correspondences
from rs_localizer.ros.node.conversion import copy_message, make_message

RUN = "import sys; from rs_localizer.ros.main import marker_detector; sys.exit(marker_detector())"
MAP = MarkerMap(wall("4x4_50", (2, 1), 0.12, 0.06), map_frame="hall")
K = np.array([[400.0, 0.0, 159.5], [0.0, 400.0, 119.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(320, 240, K)
DISTANCE = 0.6  # m, straight before the wall


def picture(ids: tuple[int, int] = (0, 1)) -> Any:
    """What the camera sees: 1 m is 667 px there, a marker 80 px and the gap 40."""
    image = np.full((240, 320), 220, np.uint8)
    for id_, column in zip(ids, (60, 180), strict=True):
        cells = np.kron(pattern(MAP.markers[0].family, id_), np.ones((14, 14)))
        drawn = cv2.resize(np.where(cells > 0, 220, 20).astype(np.uint8), (80, 80))
        image[80:160, column : column + 80] = drawn
    return image


def image(ns: int = 5, pixels: Any = None, **changes: Any) -> Image:
    pixels = picture() if pixels is None else pixels
    message = Image(height=240, width=320, encoding="mono8", step=320)
    message.header.stamp.sec, message.header.frame_id = ns, "camera"
    message.data = pixels.tobytes()
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def jpeg(ns: int, cut: int | None = None) -> CompressedImage:
    message = CompressedImage(format="jpeg")
    message.header.stamp.sec, message.header.frame_id = ns, "camera"
    message.data = cv2.imencode(".jpg", picture())[1].tobytes()[:cut]
    return message


class Talk:
    """Publishes images; listens only when told to."""

    def __init__(self, peer: Any, *kinds: type) -> None:
        self.peer = peer
        topics = {Image: "/image", CompressedImage: "/image/compressed"}
        self.publishers = {
            kind: peer.node.create_publisher(kind, topics[kind], 1) for kind in kinds
        }
        self.heard: dict[str, list[Any]] = {}

    def listen(self, kind: type, topic: str) -> Any:
        kept = self.heard.setdefault(topic, [])
        return self.peer.node.create_subscription(kind, topic, kept.append, 10)

    def wait_for_listener(self, kind: type, count: int = 1) -> None:
        publisher = self.publishers[kind]
        assert self.peer.spin_until(lambda: publisher.get_subscription_count() == count)

    def ask(self, message: Any, topic: str = "/correspondences") -> Any:
        """Send an image until it is answered."""
        stamp = message.header.stamp.sec
        for _ in range(30):
            self.publishers[type(message)].publish(message)

            def answered() -> bool:
                return any(m.header.stamp.sec == stamp for m in self.heard[topic])

            if self.peer.spin_until(answered, 0.5):
                return next(m for m in self.heard[topic] if m.header.stamp.sec == stamp)
        raise AssertionError(f"no answer on {topic}")


@pytest.fixture
def map_file(tmp_path) -> Path:
    write_marker_map(tmp_path / "map.yaml", MAP)
    return tmp_path / "map.yaml"


def set_map(peer: Any, path: Path) -> tuple[bool, str]:
    parameter = Parameter("marker_map", value=str(path)).to_parameter_msg()
    request = SetParametersAtomically.Request(parameters=[parameter])
    name = "/marker_detector/set_parameters_atomically"
    result = peer.call(SetParametersAtomically, name, request).result
    return result.successful, result.reason


def test_images_become_correspondences(start_node, peer, map_file, tmp_path):
    node = start_node("-p", f"marker_map:={map_file}", run=RUN)
    talk = Talk(peer, Image)
    node.wait_for_log("active with 2 markers")
    # Lazy: nobody listens, so the camera has no listener either.
    peer.spin_until(lambda: False, 1.0)
    assert talk.publishers[Image].get_subscription_count() == 0
    clouds = talk.listen(PointCloud2, "/correspondences")
    talk.wait_for_listener(Image)

    # The same bits as offline.
    answer = talk.ask(image(5))
    detector = FrameDetector(DetectorConfig(marker_map=str(map_file)))
    offline = correspondences(detector.take(image(5)), make_message)
    assert answer.width == 8
    assert answer == offline
    assert answer.header.frame_id == "hall"

    # Whatever comes, the next good image is answered.
    bad = {
        "bad_image: the encoding '32FC1' is not supported": {"encoding": "32FC1"},
        "bad_image: the image has no pixels: width 320, height 0": {"height": 0},
        "bad_image: the data are truncated": {"data": b"123"},
        "bad_image: step is 10, too small": {"step": 10},
    }
    for second, (text, changes) in enumerate(bad.items(), 10):
        for _ in range(20):
            talk.publishers[Image].publish(image(second, **changes))
            if peer.spin_until(lambda text=text: text in node.log, 0.5):
                break
        else:
            raise AssertionError(f"no {text!r} in:\n{node.log}")
        assert talk.ask(image(second + 20)).data == answer.data
    noise = np.random.default_rng(0).integers(0, 256, (240, 320), np.uint8)
    assert talk.ask(image(50, noise)).width == 0
    assert talk.ask(image(51, picture((0, 7)))).width == 4
    node.wait_for_log("unknown_markers: the image shows 4x4_50 7, which the map does not have")
    # Left and right exchanged.
    text = map_file.read_text().replace("id: 0", "id: X").replace("id: 1", "id: 0")
    (tmp_path / "mirrored.yaml").write_text(text.replace("id: X", "id: 1"))
    assert set_map(peer, tmp_path / "mirrored.yaml") == (True, "")
    assert talk.ask(image(60)).width == 8
    node.wait_for_log(
        "wrong_map: the map is mirrored: marker 4x4_50 1, marker 4x4_50 0 lie in the image as in"
    )
    # Maps that cannot be used are refused, and the old one stays.
    (tmp_path / "bad.yaml").write_text(map_file.read_text().replace("4x4_50", "4x4_5"))
    accepted, reason = set_map(peer, tmp_path / "bad.yaml")
    assert not accepted
    assert "marker 1 (4x4_5 0): unknown family '4x4_5'; did you mean 4x4_50?" in reason
    assert set_map(peer, map_file) == (True, "")
    assert talk.ask(image(61)).data == answer.data

    # Nobody listens any more.
    peer.node.destroy_subscription(clouds)
    talk.wait_for_listener(Image, 0)
    assert node.stop(signal.SIGINT) == 0
    assert "Traceback" not in node.log


def test_compressed_images_and_the_debug_picture(start_node, peer, map_file):
    node = start_node("-p", f"marker_map:={map_file}", run=RUN)
    talk = Talk(peer, CompressedImage)
    talk.listen(Image, "/marker_detector/debug_image")
    talk.listen(DiagnosticArray, "/diagnostics")
    talk.listen(PointCloud2, "/correspondences")
    talk.wait_for_listener(CompressedImage)
    assert talk.ask(jpeg(5)).width == 8
    for _ in range(20):
        talk.publishers[CompressedImage].publish(jpeg(6, cut=-2))
        if peer.spin_until(lambda: "the JPEG image is truncated" in node.log, 0.5):
            break
    assert talk.ask(jpeg(7)).width == 8

    # With the localizer's odometry, cubes stand on the markers.
    info = peer.node.create_publisher(CameraInfo, "/camera_info", 1)
    odometry = peer.node.create_publisher(Odometry, "/rs_localizer/odometry", 1)
    peer.node.create_publisher(PoseStamped, "/rs_localizer/pose", 1)
    assert peer.spin_until(lambda: odometry.get_subscription_count() > 0)
    answer = Odometry(child_frame_id="camera_optical_frame")
    answer.header.frame_id = "hall"
    answer.pose.pose.position.z = DISTANCE
    answer.pose.pose.orientation.x, answer.pose.pose.orientation.w = 1.0, 0.0
    debug = talk.heard["/marker_detector/debug_image"]

    def magenta(message: Any) -> Any:
        pixels = np.frombuffer(message.data, np.uint8).reshape(240, 320, 3).astype(int)
        return (pixels[..., 0] > 180) & (pixels[..., 1] < 60) & (pixels[..., 2] > 150)

    def cubes() -> bool:
        return any(message.header.stamp.sec >= 10 and magenta(message).any() for message in debug)

    for second in range(10, 40):
        info.publish(
            copy_message(make_camera_info(CAMERA, second * 10**9), "sensor_msgs/msg/CameraInfo")
        )
        talk.ask(jpeg(second))
        answer.header.stamp.sec = second
        odometry.publish(answer)
        if peer.spin_until(cubes, 0.3):
            break
    shown = next(m for m in reversed(debug) if magenta(m).any())
    assert (shown.encoding, shown.width, shown.height) == ("bgr8", 320, 240)
    # The base of the left cube is the marker's outline, and its top is larger (nearer).
    rows, columns = np.nonzero(magenta(shown)[:, :160])
    assert rows.min() < 75
    assert columns.min() < 55
    assert rows.max() > 165

    def reported() -> bool:
        status = [s for m in talk.heard["/diagnostics"] for s in m.status]
        ours = [s for s in status if s.name == "marker_detector: marker_detector"]
        values = [{v.key: v.value for v in s.values} for s in ours]
        return any(
            (v.get("Markers"), v.get("Corners"), v.get("Refused: bad_image", "0") != "0")
            == ("2", "8", True)
            for v in values
        )

    assert peer.spin_until(reported)
    assert node.stop(signal.SIGTERM) == 0


# Modules, packages not counted.
MOST = {"markers": 50, "features": 41}


@pytest.mark.parametrize("kind", MOST)
def test_the_detectors_do_not_import_the_estimator(kind):
    code = (
        f"import sys, rs_localizer.ros.detector.{kind}\n"
        "print(*(n for n, m in sys.modules.items() if n.startswith('rs_localizer.')"
        " and not hasattr(m, '__path__')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    names = done.stdout.split()
    parts = {name.split(".")[1] for name in names}
    assert parts.isdisjoint({"estimation", "localizer", "tracking", "trajectory", "matching"})
    assert kind == "markers" or "markers" not in parts
    assert len(names) < MOST[kind]
