# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags of `simulate`: what they hold, and that their truth is the truth of their frames; and what
replay makes of an IMU in them.
"""

import re
import shlex
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
from recorded import record
from scipy.spatial.transform import Rotation

from rs_localizer.cli.commands import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_files import lens_parameters
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.trajectories import read_motions
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.settings import load_params_file, write_camera_file

TURN = ("--angular-velocity", "0.5", "-1", "2", "--linear-velocity", "0.2", "0", "0")
SHORT = ("--duration", "1", "--points", "60")


def simulate(out: Path, *words: str) -> int:
    return main(["simulate", str(out), *words])


@pytest.mark.parametrize(
    ("topic", "words"),
    [
        ("/correspondences", []),
        ("/image_raw/compressed", ["--images"]),
    ],
)
def test_bag_holds_frames_and_their_truth(tmp_path, topic, words):
    more = ("--duration", "0.3", "--readout-time", "0.02")
    assert simulate(tmp_path / "bag", *words, *more) == 0
    with open_bag(tmp_path / "bag") as bag:
        messages = list(bag.messages(bag.topics))
    assert messages[0][0] == "/camera_info"  # or the first frame would be lost
    assert Counter(name for name, _, _ in messages) == {
        "/camera_info": 9, topic: 9, "/truth/pose": 18, "/truth/twist": 18,
    }  # fmt: skip
    frames = [message for name, _, message in messages if name == topic]
    stamps = [stamp_ns(message) for message in frames]
    assert stamps[0] == 1_000_000_000
    np.testing.assert_allclose(np.diff(stamps), 1e9 / 30, atol=2)
    # At the first row and at the middle one, so that either pose_time has its exact truth.
    truth = {stamp_ns(m) for name, _, m in messages if name == "/truth/pose"}
    assert truth == set(stamps) | {stamp + 10_000_000 for stamp in stamps}
    ids = {name: message.header.frame_id for name, _, message in messages}
    camera = "camera_optical_frame"
    assert ids == {
        "/camera_info": camera, "/truth/twist": camera, "/truth/pose": "map",
        topic: "map" if topic == "/correspondences" else camera,
    }  # fmt: skip
    if topic == "/correspondences":
        assert len(set(read_correspondences(frames[0]).table["id"])) == 150
    else:
        assert frames[0].format == "jpeg"
        assert cv2.imdecode(frames[0].data, cv2.IMREAD_UNCHANGED).shape == (480, 640)


def test_the_next_command_has_the_shutter(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ("--readout-time", "0.025", "--scan-direction", "bottom_to_top", "--duration", "0.2")
    assert simulate(Path("my bag"), *words) == 0
    *_, line = capsys.readouterr().out.splitlines()
    label, program, *command = shlex.split(line)
    assert (label, Path(program).name) == ("next:", "rs_localizer")
    assert load_params_file(tmp_path / "my bag" / "parameters.yaml") == {
        "readout_time": 0.025,
        "scan_direction": "bottom_to_top",
    }
    assert main(command) == 0
    assert main(["evaluate", "my bag_poses", "my bag"]) == 0


def test_markers_are_where_map_and_truth_put_them(tmp_path):
    """Each corner projected at the time of its own line, by the pose and twist in the bag.

    Lens and shutter are those of one file, of which an option takes one back.
    """
    file, D = tmp_path / "camera.yaml", np.array([-0.2, 0.05, 0.001, -0.001])
    K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
    shutter = {"readout_time": 0.03, "scan_direction": "left_to_right"}
    write_camera_file(file, shutter, lens_parameters(Camera(640, 480, K, D)))
    words = ("--images", *TURN, "--camera", str(file), "--duration", "0.1")
    words += ("--scan-direction", "right_to_left")
    noise = ("--exposure", "0.002", "--noise", "1")
    assert simulate(tmp_path / "bag", *words, *noise) == 0
    corners = {m.id: m.corners for m in read_marker_map(tmp_path / "bag/marker_map.yaml").markers}
    truth = read_motions(tmp_path / "bag", "/truth/pose", "/truth/twist")
    assert truth.twists is not None
    with open_bag(tmp_path / "bag") as bag:
        info = next(m for _, _, m in bag.messages(["/camera_info"]))
        images = [m for _, _, m in bag.messages(["/image_raw/compressed"])]
    camera = read_camera_info(info).camera(0.03, "right_to_left")
    errors = []
    for message in images:
        row = truth.poses.stamps_ns.tolist().index(stamp_ns(message))
        for number, seen in detect(cv2.imdecode(message.data, cv2.IMREAD_GRAYSCALE)).items():
            late = 0.03 * (1 - seen[:, :1] / 639)
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


def test_replay_uses_it_and_says_so(tmp_path, ran):
    record(tmp_path / "bag", *SHORT, *TURN, "--imu")
    replay = ["replay", str(tmp_path / "bag"), "-p", "readout_time:=0.03"]
    poses = []
    for name, words in (("both", []), ("alone", ["-p", "imu.use:=none"])):
        said = ran(*replay, "--out", tmp_path / name, *words).out
        assert ("IMU used (share of" in said) == (name == "both")
        if name == "both":
            assert re.search(r"IMU used \(share of the last frames\) +(9\d|100)%", said)
            assert re.search(r"IMU time offset \(ms\) +-?\d+\.\d\d", said)
        poses.append((tmp_path / name / "poses.txt").read_bytes())
    assert poses[0] != poses[1]
    more = [*replay, "--out", str(tmp_path / "n"), "-r"]
    assert "/nowhere does not exist" in ran(*more, "imu:=/nowhere", code=1).err
    assert main([*more, "imo:=/imu"]) == 2
