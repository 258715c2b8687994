"""``rs_localizer calibrate``, ``readout`` and ``replay --smooth``: the real recording, faults."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from rs_localizer import data
from rs_localizer.cli.main import main
from rs_localizer.io.calibration.files import read_calibration
from rs_localizer.io.trajectories import read_tum
from rs_localizer.settings import load_params_file


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("flight") / "flight"
    words = "--trajectory tum_vi_room5 --duration 3 --points 60 --noise 0.5 --readout-time 0.02"
    assert main(["simulate", str(out), *words.split()]) == 0
    return out


@pytest.mark.parametrize(
    "words",
    [
        "--map {wall}",
        "--board 9x6 --square 0.02",
        "--board 4x11 --square 0.02 --pattern asymmetric_circles",
    ],
)
def test_what_is_looked_for_in_images(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str
) -> None:
    """As ``detect`` has it: the images of a video are what is missing here."""
    assert main(["markers", "make", str(tmp_path / "wall"), "--standing"]) == 0
    video = tmp_path / "grey.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (320, 240))
    for _ in range(5):
        writer.write(np.full((240, 320, 3), 128, np.uint8))
    writer.release()
    wanted = words.format(wall=tmp_path / "wall.yaml").split()
    assert main(["calibrate", str(video), *wanted]) == 1
    said = capsys.readouterr()
    assert "0 of 5 images show the map" in said.out
    assert "Traceback" not in said.err


def test_the_webcam(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, plots = tmp_path / "webcam.yaml", tmp_path / "plots"
    recording = str(data.path(data.WEBCAM))
    words = ["calibrate", recording, "--intrinsics", "--out", str(out), "--plots", str(plots)]
    assert main(words) == 0
    values = load_params_file(out)
    # A third of the interval, by single poses (see ATTRIBUTION.md); its stamps are not its own.
    assert 0.010 < values["readout_time"] < 0.015
    assert 0.0 < values["readout_time_deviation"] < 2e-3
    assert values["scan_direction"] == "top_to_bottom"
    assert "beside their stamps" in capsys.readouterr().out
    camera = read_calibration(tmp_path / "webcam_camera_info.yaml")
    assert camera.K[0, 0] == pytest.approx(529.0, rel=0.02)
    assert {file.name for file in plots.iterdir()} == {"readout_time.png", "residuals.png"}


def test_a_simulated_flight_against_the_assumed_direction(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "camera.yaml"
    words = ["-p", "scan_direction:=bottom_to_top", "--out", str(out)]
    assert main(["calibrate", str(flight), *words]) == 0
    values = load_params_file(out)
    assert values["scan_direction"] == "top_to_bottom"
    assert abs(values["readout_time"] - 0.02) < 4.0 * values["readout_time_deviation"]


def test_faults(flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", str(tmp_path / "nothing")]) == 1
    assert main(["calibrate", str(flight), "--out", str(tmp_path / "x.txt")]) == 2
    assert main(["calibrate", str(flight), "--board", "5x4", "--square", "0.1"]) == 2
    video, nothing = tmp_path / "video.mjpeg", tmp_path / "nothing.mp4"
    video.write_bytes(2 * cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))[1].tobytes())
    assert main(["calibrate", str(video), "--board", "5x4", "--square", "0.1"]) == 2
    nothing.touch()
    assert main(["calibrate", str(nothing), "--board", "5x4", "--square", "0.1"]) == 1
    assert "Traceback" not in capsys.readouterr().err


def test_smooth(flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    params = ["--params", str(flight / "parameters.yaml")]
    plain, smooth, fast = (tmp_path / name for name in ("plain", "smooth", "fast"))
    assert main(["replay", str(flight), *params, "--out", str(plain)]) == 0
    assert main(["replay", str(flight), *params, "--smooth", "--out", str(smooth)]) == 0
    more = ["--smooth", "--rate", "200", "--out", str(fast)]
    assert main(["replay", str(flight), *params, *more]) == 0
    one, other = read_tum(plain / "poses.txt"), read_tum(smooth / "poses.txt")
    np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
    assert 0.0 < np.abs(one.positions - other.positions).max() < 0.1
    dense = read_tum(fast / "poses.txt")
    assert np.diff(dense.stamps_ns).min() == pytest.approx(5e6, abs=2)
    assert (fast / "bridged.txt").read_text() == ""
    capsys.readouterr()
    assert main(["replay", str(flight), "--smooth", "--out", str(tmp_path / "none")]) == 1
    assert "readout time" in capsys.readouterr().err
    assert main(["replay", str(flight), "--rate", "10", "--out", str(tmp_path / "none")]) == 2


def test_readout(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["readout", "imx219", "1920x1080"]) == 0
    assert "20.40" in capsys.readouterr().out
    assert main(["readout", "no such camera"]) == 1
