# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map build``: what it refuses, and that nothing is half-written."""

import cv2
import numpy as np
import pytest

from rs_localizer.cli.commands import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.camera_files import write_calibration
from rs_localizer.tools.simulation.walls import collage

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
        ([picture(k) for k in range(6)], "no two of the 6 keyframes determine a structure"),
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
    words = ["map", "build", str(tmp_path / "images"), *given, "-p", "readout_time:=0.03"]
    assert main([*words, "--out", str(tmp_path / "map")]) == 1
    assert not (tmp_path / "map").exists()
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert text in line
