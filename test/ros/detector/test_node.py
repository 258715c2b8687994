# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The marker detector as its users meet it: its own process, real DDS, images of all kinds."""

import signal
from typing import Any

import cv2
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import CompressedImage, Image, PointCloud2

from rs_localizer.config import DetectorConfig
from rs_localizer.io.images import read_image
from rs_localizer.markers.dictionaries import pattern
from rs_localizer.markers.map_files import write_marker_map
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.pipeline.marker_detector import FrameDetector, correspondences
from rs_localizer.ros.node.conversion import make_message

from .talk import Talk

RUN = "import sys; from rs_localizer.ros.main import marker_detector; sys.exit(marker_detector())"
MAP = MarkerMap(wall("4x4_50", (2, 1), 0.12, 0.06), map_frame="hall")


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


def test_images_become_correspondences(start_node, peer, tmp_path):
    map_file = tmp_path / "map.yaml"
    write_marker_map(map_file, MAP)
    node = start_node("-p", f"marker_map:={map_file}", run=RUN)
    talk = Talk(peer, "marker_detector")
    node.wait_for_log("active with 2 markers")
    # Lazy: nobody listens, so the camera has no listener either.
    peer.spin_until(lambda: False, 0.6)
    assert talk.publisher.get_subscription_count() == 0
    clouds = talk.listen(PointCloud2, "/correspondences")
    assert talk.listeners(1)

    def ask(message: Any) -> Any:
        return talk.ask(message, "/correspondences")

    # The same bits as offline.
    answer = ask(image(5))
    detector = FrameDetector(DetectorConfig(marker_map=str(map_file)))
    assert answer.width == 8
    assert answer == correspondences(detector.detect(read_image(image(5))), make_message)
    assert answer.header.frame_id == "hall"

    # Whatever comes, the next good image is answered.
    bad = {
        "bad_image: the encoding '32FC1' is not supported": {"encoding": "32FC1"},
        "bad_image: the image has no pixels: width 320, height 0": {"height": 0},
        "bad_image: the data are truncated": {"data": b"123"},
    }
    for second, (text, changes) in enumerate(bad.items(), 10):
        talk.send_until(image(second, **changes), lambda text=text: text in node.log)
        assert ask(image(second + 20)).data == answer.data
    noise = np.random.default_rng(0).integers(0, 256, (240, 320), np.uint8)
    assert ask(image(50, noise)).width == 0
    assert ask(image(51, picture((0, 7)))).width == 4
    node.wait_for_log("unknown_markers: the image shows 4x4_50 7, which the map does not have")
    # Maps that cannot be used are refused, and the old one stays.
    (tmp_path / "bad.yaml").write_text(map_file.read_text().replace("4x4_50", "4x4_5"))
    accepted, reason = talk.set("marker_map", str(tmp_path / "bad.yaml"))
    assert not accepted
    assert "marker 1 (4x4_5 0): unknown family '4x4_5'; did you mean 4x4_50?" in reason
    assert talk.set("marker_map", str(map_file)) == (True, "")
    assert ask(image(61)).data == answer.data

    # Another driver: compressed images.
    peer.node.destroy_publisher(talk.publisher)
    talk.open(CompressedImage)
    assert talk.listeners(1)
    assert ask(jpeg(105)).width == 8
    talk.send_until(jpeg(106, cut=-2), lambda: "the JPEG image is truncated" in node.log)

    # The debug picture has markers in colours.
    pictures = talk.listen(Image, "/marker_detector/debug_image")
    talk.listen(DiagnosticArray, "/diagnostics")
    shown = talk.ask(jpeg(110), "/marker_detector/debug_image")
    assert (shown.encoding, shown.width, shown.height) == ("bgr8", 320, 240)
    pixels = np.frombuffer(shown.data, np.uint8).reshape(240, 320, 3).astype(int)
    rows, columns = np.nonzero(np.ptp(pixels, axis=2) > 60)
    assert abs(rows.min() - 80) < 8
    assert abs(columns.max() - 260) < 8
    said = {"Markers": "2", "Corners": "8", "Refused: bad_image": None}
    assert peer.spin_until(lambda: talk.reported(said))

    # Nobody listens any more.
    peer.node.destroy_subscription(clouds)
    peer.node.destroy_subscription(pictures)
    assert talk.listeners(0)
    assert node.stop(signal.SIGTERM) == 0
    assert "Traceback" not in node.log
