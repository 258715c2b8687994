# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What detect makes of its sources: times, boards, what it keeps of a bag, and what it warns of."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from recorded import imu, tf
from scipy.spatial.transform import Rotation

from rs_localizer.cli.main import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, make_message, open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.recording import make_camera_info
from rs_localizer.io.trajectories import read_motions
from rs_localizer.offline import detect as detecting

K = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(320, 240, K)
SQUARE = 0.03
TURN = Rotation.from_euler("YX", [25.0, -20.0], degrees=True).as_matrix()  # camera_from_map
DEPTH = 0.45
PIXELS, FINE = 40, 4  # of a square as drawn, and of an image before it is shrunk


def place(columns: int, rows: int, x: int = 0) -> Any:
    """Where the first corner of a board is in the camera: the middle is in front of it."""
    middle = np.array([columns - 1, rows - 1, 0.0]) * SQUARE / 2
    return np.array([0.001 * x, 0.0, DEPTH]) - TURN @ middle


def board(columns: int, rows: int, x: int = 0) -> Any:
    """A chessboard by its inner corners; every x, it has moved by a millimetre."""
    v, u = np.mgrid[: rows + 1, : columns + 1]
    squares = np.where((u + v) % 2, 230, 20).astype(np.uint8)
    drawn = np.pad(np.kron(squares, np.ones((PIXELS, PIXELS), np.uint8)), 1, constant_values=230)
    scale = SQUARE / PIXELS  # metres from the first corner, which is between two pixels
    metres = np.diag([scale, scale, 1.0])
    metres[:2, 2] = -scale * (PIXELS + 0.5)
    to_image = K @ np.column_stack([TURN[:, :2], place(columns, rows, x)]) @ metres
    half = (FINE - 1) / 2
    fine = np.array([[FINE, 0, half], [0, FINE, half], [0, 0, 1.0]])
    large = cv2.warpPerspective(drawn, fine @ to_image, (320 * FINE, 240 * FINE), borderValue=230)
    small = cv2.resize(large, (320, 240), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), 0.5)


@pytest.fixture
def here(tmp_path) -> SimpleNamespace:
    (tmp_path / "camera.json").write_text(
        '{"width": 320, "height": 240, "fx": 300, "fy": 300, "cx": 159.5, "cy": 119.5}'
    )
    return SimpleNamespace(
        path=tmp_path,
        out=tmp_path / "out",
        calibration=("--calibration", str(tmp_path / "camera.json")),
        board=("--board", "6x4", "--square", "0.03"),
    )


def mp4(path: Path, images: list[Any], rate: float) -> str:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), rate, (320, 240))
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    return str(path)


def folder(path: Path, images: list[Any]) -> str:
    path.mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(path / f"{k:04}.png"), image)
    return str(path)


def detect(here: Any, source: str, *words: str) -> int:
    return main(["detect", source, *here.calibration, *words, "--out", str(here.out)])


def stamps(path: Path) -> list[int]:
    with open_bag(path) as bag:
        return [stamp_ns(message) for _, _, message in bag.messages(["/correspondences"])]


def test_a_video_has_its_own_times(here, capsys):
    video = mp4(here.path / "a.mp4", [board(6, 4, x) for x in range(4)], 20.0)
    assert detect(here, video, *here.board, "--readout-time", "0.06", "--start", "7.5") == 0
    assert stamps(here.out) == [7_500_000_000 + 50_000_000 * k for k in range(4)]
    said = capsys.readouterr().out
    assert "presentation times of the video, 20 images/s on average; the first image at 7.5" in said
    assert "warning: the readout time of 60 ms is longer than the 50 ms from image to im" in said


def test_another_board_is_named_after_the_first_images(here, monkeypatch, capsys):
    monkeypatch.setattr(detecting, "_PATIENCE", 4)
    images = folder(here.path / "images", [board(7, 5)] * 6)
    assert detect(here, images, *here.board, "--rate", "30") == 1
    said = capsys.readouterr().err
    shows = r"shows anything of the map \(chessboard 6x4\); they show a chessboard of 7x5 inner"
    assert re.search(f"note: none of the first 4 images {shows}", said)
    assert re.search(f"detect: none of the 6 images {shows}", said)
    assert not here.out.exists()


def test_a_wrong_calibration_is_named(here, capsys):
    text = (here.path / "camera.json").read_text()
    (here.path / "camera.json").write_text(text.replace('"fy": 300', '"fy": 900'))
    images = folder(here.path / "images", [board(6, 4)] * 3)
    assert detect(here, images, *here.board, "--rate", "30") == 0
    said = capsys.readouterr().out
    assert re.search(r"warning: even the stillest images leave \d+\.\d px rms: the calib", said)


def test_a_board_of_exactly_min_inliers_corners(here):
    images = folder(here.path / "images", [board(4, 3, x) for x in range(12)])
    assert detect(here, images, "--board", "4x3", "--square", "0.03", "--rate", "30") == 0
    poses = here.path / "poses"
    assert main(["replay", str(here.out), "-p", "readout_time:=0.02", "--out", str(poses)]) == 0
    found = read_motions(poses).poses
    assert len(found) == 12
    expected = -TURN.T @ place(4, 3)
    np.testing.assert_allclose(np.median(found.positions, axis=0), expected, atol=0.01)


@pytest.mark.parametrize("own_calibration", [True, False])
def test_transforms_and_imu_of_a_bag_are_kept(here, own_calibration, capsys):
    start = 100 * 10**9  # the recorder's clock is another one than the stamps
    with BagWriter(here.path / "bag") as bag:
        bag.write(
            "/tf_static", tf("base_link", "eye", (0.0, 0.0, 2.0), Rotation.identity(), 5), start
        )
        for k in range(6):
            stamp = 10**9 + 33_000_000 * k
            png = cv2.imencode(".png", board(6, 4, k))[1].tobytes()
            bag.write("/camera_info", make_camera_info(CAMERA, stamp, "eye"), start + stamp)
            image = make_message(
                "sensor_msgs/msg/CompressedImage",
                header=make_camera_info(CAMERA, stamp, "eye").header,
                format="png",
                data=np.frombuffer(png, np.uint8),
            )
            bag.write("/image", image, start + stamp)
            bag.write("/imu/data", imu(stamp), start + stamp + 7)
            bag.write(
                "/tf",
                tf("base_link", "wheel", (0.0, 0.0, 2.0), Rotation.identity(), 5),
                start + stamp,
            )
    calibration = here.calibration if own_calibration else ()
    words = ["detect", str(here.path / "bag"), *calibration, *here.board, "--out", str(here.out)]
    assert main(words) == 0
    assert "kept for replay: /tf_static (1), " in capsys.readouterr().out
    with open_bag(here.out) as bag:
        assert {topic: bag.count([topic]) for topic in ("/tf_static", "/tf", "/imu/data")} == {
            "/tf_static": 1, "/tf": 6, "/imu/data": 6,
        }  # fmt: skip
        times = [ns for _, ns, _ in bag.messages(["/imu/data", "/correspondences"])]
    assert times == sorted(times)
    assert times[1] - times[0] == 7
    durability = (here.out / "metadata.yaml").read_text().count("durability: transient_local")
    assert durability == 1
    # The camera hangs where the recording has it: 2 m before the body, along its own axis.
    poses = here.path / "poses"
    settings = ["-p", "base_frame:=base_link", "-p", "readout_time:=0.02"]
    assert main(["replay", str(here.out), *settings, "--out", str(poses)]) == 0
    found = read_motions(poses).poses.positions
    expected = -TURN.T @ (place(6, 4) + 2.0 * np.eye(3)[2])
    np.testing.assert_allclose(np.median(found, axis=0), expected, atol=0.05)
