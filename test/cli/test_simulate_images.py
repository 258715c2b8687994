# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The bag of `simulate --images`: what it holds, and that markers are where its truth says."""

from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.cli.main import main
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.trajectories import read_motions
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.settings import load_params_file

TURN = ("--angular-velocity", "0.4", "0.8", "-0.5", "--linear-velocity", "1", "0.5", "0")
SMALL = ("--width", "320", "--height", "240", "--focal", "250")


def simulate(out: Path, *words: str) -> int:
    return main(["simulate", str(out), "--images", *words])


def messages(bag_path: Path) -> list:
    with open_bag(bag_path) as bag:
        return list(bag.messages(bag.topics))


def test_bag_holds_images_and_their_truth(tmp_path):
    out = tmp_path / "bag"
    assert simulate(out, *SMALL, "--duration", "0.3", "--readout-time", "0.02") == 0
    found = messages(out)
    assert found[0][0] == "/camera_info"  # or the first frame would be lost
    assert Counter(topic for topic, _, _ in found) == {
        "/camera_info": 9, "/image_raw/compressed": 9, "/truth/pose": 18, "/truth/twist": 18,
    }  # fmt: skip
    images = [m for topic, _, m in found if topic == "/image_raw/compressed"]
    assert {(m.format, m.header.frame_id) for m in images} == {("jpeg", "camera_optical_frame")}
    assert cv2.imdecode(images[0].data, cv2.IMREAD_UNCHANGED).shape == (240, 320)
    stamps = [stamp_ns(m) for m in images]
    truth = {stamp_ns(m) for topic, _, m in found if topic == "/truth/pose"}
    assert truth == set(stamps) | {stamp + 10_000_000 for stamp in stamps}
    assert load_params_file(out / "parameters.yaml")["readout_time"] == 0.02
    assert {p.name for p in out.iterdir()} >= {"marker_map.yaml", "metadata.yaml", "bag.mcap"}


@pytest.mark.parametrize("direction", ["top_to_bottom", "right_to_left"])
def test_markers_are_where_map_and_truth_put_them(tmp_path, direction):
    """Each corner projected at the time of its own line, by the pose and twist in the bag."""
    lens = ("--distortion", "-0.2", "0.05", "0.001", "-0.001")
    words = (*TURN, *lens, "--duration", "0.1", "--scan-direction", direction, "--format", "png")
    assert simulate(tmp_path / "bag", *words, "--exposure", "0.002", "--grey-noise", "1") == 0
    corners = {m.id: m.corners for m in read_marker_map(tmp_path / "bag/marker_map.yaml").markers}
    truth = read_motions(tmp_path / "bag", "/truth/pose", "/truth/twist")
    assert truth.twists is not None
    info = next(m for topic, _, m in messages(tmp_path / "bag") if topic == "/camera_info")
    camera = read_camera_info(info).camera(0.03, direction)
    errors = []
    for topic, _, message in messages(tmp_path / "bag"):
        if topic != "/image_raw/compressed":
            continue
        row = truth.poses.stamps_ns.tolist().index(stamp_ns(message))
        for number, seen in detect(cv2.imdecode(message.data, cv2.IMREAD_GRAYSCALE)).items():
            along = seen[:, 1] / 479 if "top" in direction else 1 - seen[:, 0] / 639
            late = 0.03 * along[:, None]
            start = Rotation.from_quat(truth.poses.quaternions[row])
            turned = start * Rotation.from_rotvec(late * truth.twists.angular[row])
            travel = late * start.apply(truth.twists.linear[row])
            local = corners[number] - truth.poses.positions[row] - travel
            errors.append(seen - camera.project(turned.inv().apply(local)))
    offsets = np.concatenate(errors)
    assert len(offsets) > 60
    assert np.median(np.linalg.norm(offsets, axis=1)) < 0.4
    assert np.abs(np.median(offsets, axis=0)).max() < 0.05


def detect(image: np.ndarray) -> dict[int, np.ndarray]:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    if hasattr(cv2.aruco, "ArucoDetector"):
        corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
    else:  # OpenCV 4.6
        corners, ids, _ = cv2.aruco.detectMarkers(image, dictionary)
    found = {}
    for number, quad in zip(ids.ravel(), corners, strict=True):
        # A window on the scale of the marker, so that it holds no other corner.
        window = int(np.clip(np.linalg.norm(quad[0] - quad[0, 1], axis=1).max() / 12, 2, 5))
        refined = cv2.cornerSubPix(
            image, np.array(quad[0][:, None]), (window, window), (-1, -1), (3, 30, 1e-3)
        )
        found[int(number)] = refined[:, 0].astype(np.float64)
    return found
