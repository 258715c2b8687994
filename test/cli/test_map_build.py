# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map build``: what it refuses, and that nothing is half-written."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rs_localizer.cli.main import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.calibration import write_calibration
from rs_localizer.simulation.walls import collage

K = np.array([[260.0, 0.0, 159.5], [0.0, 260.0, 119.5], [0.0, 0.0, 1.0]])
SIZE = (320, 240)


@pytest.fixture
def calibration(tmp_path) -> Path:
    path = tmp_path / "camera.yaml"
    write_calibration(path, Camera(*SIZE, K))
    return path


def written(folder: Path, images: list[np.ndarray]) -> Path:
    folder.mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(str(folder / f"{number}.png"), image)
    return folder


def build(images: Path, calibration: Path, out: Path, *more: str) -> int:
    given = ["--calibration", str(calibration), "--rate", "15", "--readout-time", "0.03"]
    return main(["map", "build", str(images), *given, "--out", str(out), *more])


def refused(images: Path, calibration: Path, capsys: pytest.CaptureFixture[str], *more: str) -> str:
    """What is said of images that make no map; nothing is left of it."""
    out = images.parent / "map"
    assert build(images, calibration, out, *more) == 1
    assert not out.exists()
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def picture(seed: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    return collage(*size, np.random.default_rng(seed))


@pytest.fixture
def _with_pycolmap() -> None:
    pytest.importorskip("pycolmap")


pytestmark = pytest.mark.usefixtures("_with_pycolmap")


def test_blank_walls(tmp_path, calibration, capsys):
    images = written(tmp_path / "images", 5 * [np.full(SIZE[::-1], 90, np.uint8)])
    assert "the images show 0 features each (median)" in refused(images, calibration, capsys)


def test_no_overlap(tmp_path, calibration, capsys):
    images = written(tmp_path / "images", [picture(k) for k in range(6)])
    said = refused(images, calibration, capsys)
    assert "no two of the 6 keyframes determine a structure" in said
    assert "0 pairs" in said


def test_repeated_texture(tmp_path, calibration, capsys):
    tiles = np.tile(picture(0, (64, 64)), (9, 9))
    images = [tiles[4 * k : 4 * k + SIZE[1], 11 * k : 11 * k + SIZE[0]] for k in range(16)]
    said = refused(written(tmp_path / "images", images), calibration, capsys)
    assert "texture that does not repeat" in said


def test_files_that_are_broken(tmp_path, calibration, capsys):
    images = tmp_path / "images"
    images.mkdir()
    for number in range(3):
        (images / f"{number}.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    assert "no image that can be read" in refused(images, calibration, capsys)
