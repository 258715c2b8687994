"""``rs_localizer map build``: what it refuses, and that nothing is half-written."""

import sys
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


def test_without_pycolmap(tmp_path, calibration, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    images = written(tmp_path / "images", [picture(0)])
    assert "pip install pycolmap" in refused(images, calibration, capsys)


@pytest.fixture
def _with_pycolmap() -> None:
    pytest.importorskip("pycolmap")


pytestmark = pytest.mark.usefixtures("_with_pycolmap")


def test_blank_walls(tmp_path, calibration, capsys):
    images = written(tmp_path / "images", 5 * [np.full(SIZE[::-1], 90, np.uint8)])
    assert "the images show 0 features each (median)" in refused(images, calibration, capsys)


def test_a_blurred_video(tmp_path, calibration, capsys):
    blurred = [cv2.GaussianBlur(picture(k), (0, 0), 25.0) for k in range(5)]
    images = written(tmp_path / "images", blurred)
    assert "are they blurred, dark, or of blank walls?" in refused(images, calibration, capsys)


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


@pytest.mark.parametrize(
    ("more", "fault"),
    [
        (("--distance", "a", "b", "-1"), "must be two points and metres"),
        (("--distance", "a", "a", "1"), "must be two points and metres"),
        (("--point", "a", "0", "x", "3"), "must be a number"),
        (("--point", "a", "0", "2", "3"), "says nothing without a --distance"),
        (("--distance", "a", "b", "1", "--point", "a", "0", "2", "3"), "in two images or more"),
        (("--markers", "wall.yaml", "--point", "a", "0", "1", "2"), "give either --markers"),
    ],
)
def test_wrong_usage(tmp_path, calibration, capsys, more, fault):
    images = written(tmp_path / "images", [picture(0)])
    assert build(images, calibration, tmp_path / "map", *more) == 2
    assert fault in capsys.readouterr().err


def test_what_is_there_is_not_overwritten(tmp_path, calibration, capsys):
    images = written(tmp_path / "images", [picture(0)])
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "kept").touch()
    assert build(images, calibration, tmp_path / "map") == 1
    assert "exists already" in capsys.readouterr().err
    assert (tmp_path / "map" / "kept").exists()
