# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map build``: what it refuses, and that nothing is half-written."""

import argparse
from pathlib import Path

import cv2
import numpy as np
import pytest

from rs_localizer.cli import UsageError
from rs_localizer.cli.main import main
from rs_localizer.cli.map.build import add_imu_arguments, imu_of
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.calibration import write_calibration
from rs_localizer.io.imu import ImuFileError
from rs_localizer.offline.image_sources import SourceError
from rs_localizer.simulation.walls import collage

K = np.array([[260.0, 0.0, 159.5], [0.0, 260.0, 119.5], [0.0, 0.0, 1.0]])
SIZE = (320, 240)


def picture(seed: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    return collage(*size, np.random.default_rng(seed))


@pytest.fixture
def _with_pycolmap() -> None:
    pytest.importorskip("pycolmap")


pytestmark = pytest.mark.usefixtures("_with_pycolmap")
TILES = np.tile(picture(0, (64, 64)), (9, 9))


@pytest.mark.parametrize(
    ("images", "text"),
    [
        (5 * [np.full(SIZE[::-1], 90, np.uint8)], "the images show 0 features each (median)"),
        (
            [picture(k) for k in range(6)],
            "no two of the 6 keyframes determine a structure",
        ),
        (
            [TILES[4 * k : 4 * k + SIZE[1], 11 * k : 11 * k + SIZE[0]] for k in range(16)],
            "texture that does not repeat",
        ),
        ([], "no image that can be read"),
    ],
    ids=["blank walls", "no overlap", "repeated texture", "broken files"],
)
def test_what_makes_no_map_is_said_and_leaves_nothing(tmp_path, images, text, capsys):
    write_calibration(tmp_path / "camera.yaml", Camera(*SIZE, K))
    (tmp_path / "images").mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(str(tmp_path / "images" / f"{number}.png"), image)
    if not images:
        (tmp_path / "images" / "0.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    given = ["--calibration", str(tmp_path / "camera.yaml"), "--rate", "15"]
    words = ["map", "build", str(tmp_path / "images"), *given, "--readout-time", "0.03"]
    assert main([*words, "--out", str(tmp_path / "map")]) == 1
    assert not (tmp_path / "map").exists()
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert text in line


def given(images: Path, *words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_imu_arguments(parser.add_argument_group("IMU"))
    known = argparse.Namespace(images=images, image=None, camera_info=None)
    return parser.parse_args(list(words), known)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """With an IMU at rest beside the camera."""
    out = tmp_path_factory.mktemp("recorded") / "bag"
    words = ["--duration", "0.3", "--points", "20", "--imu", "--accelerometer-bias", "0"]
    assert main(["simulate", str(out), *words, "--accelerometer-noise", "0"]) == 0
    return out


def test_that_of_a_bag_is_found(recorded):
    """Forces, and where TF says that it is."""
    imu = imu_of(given(recorded))
    assert imu is not None
    assert not imu.asked
    forces = imu.recording.specific_forces
    assert forces is not None
    np.testing.assert_allclose(np.linalg.norm(forces, axis=1), 9.80665, rtol=0.05)
    assert imu.recording.camera_from_imu is not None
    np.testing.assert_allclose(imu.recording.imu_in_camera, [0.03, -0.02, -0.01], atol=1e-9)


def test_of_several_none_is_taken(recorded, tmp_path, capsys):
    with open_bag(recorded) as bag, BagWriter(tmp_path / "two") as out:
        for _, stamp_ns, message in bag.messages(["/imu"]):
            out.write("/left", message, stamp_ns)
            out.write("/right", message, stamp_ns)
    assert imu_of(given(tmp_path / "two")) is None
    assert "choose /left or /right with --imu" in capsys.readouterr().out
    with pytest.raises(SourceError, match="choose one with --imu"):
        imu_of(given(tmp_path / "two", "--imu"))
    assert imu_of(given(tmp_path / "two", "--imu", "/left")) is not None


def test_a_video_may_have_a_file_beside_it(tmp_path):
    path = tmp_path / "data.csv"
    path.write_text("#timestamp [ns],...\n1000,1,2,3,4,5,6\n2000,1,2,3,4,5,7\n")
    video = tmp_path / "walk.mp4"
    imu = imu_of(given(video, "--imu", str(path)))
    assert imu is not None
    assert imu.asked
    assert imu.recording.camera_from_imu is None
    np.testing.assert_array_equal(imu.recording.specific_forces, [[4, 5, 6], [4, 5, 7]])
    assert imu_of(given(video)) is None
    with pytest.raises(UsageError, match=r"give --imu FILE\.csv"):
        imu_of(given(video, "--imu"))
    with pytest.raises(ImuFileError, match="cannot be read"):
        imu_of(given(video, "--imu", "/imu"))
