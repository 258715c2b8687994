# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Examples start as their pages say, find what is true, and name what is missing in a line."""

import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from typed_commands import EXAMPLES, commands, started

import rs_localizer as rsl
from rs_localizer import data
from rs_localizer.io.trajectories import read_tum
from rs_localizer.markers.map_files import read_marker_map

WITH_ARGUMENTS = sorted(p for p in EXAMPLES.glob("*.py") if "__main__" in p.read_text())


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the page's commands for a table have been typed."""
    pytest.importorskip("pyarrow", exc_type=ImportError)
    made = tmp_path_factory.mktemp("clone")
    (made / "examples").symlink_to(EXAMPLES)
    for line in commands("README.md")[1:]:
        done = started(line, made)
        assert done.returncode == 0, (line, done.stderr)
    return made


@pytest.mark.parametrize(
    "name", ["to_gsplat", "to_nerfstudio", "to_ncore", "to_rerun", "to_global_shutter"]
)
def test_what_reads_a_table_runs_as_its_head_says(name, folder):
    if name == "to_rerun":
        pytest.importorskip("rerun")
    *_, line = commands(f"{name}.py")
    done = started(line, folder)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    assert re.fullmatch(r"[\w.]+: 15 images\n", done.stdout)


@pytest.mark.parametrize("path", WITH_ARGUMENTS, ids=lambda path: path.stem)
def test_wrong_arguments_are_answered_in_a_line(path, monkeypatch):
    words = ["a", "b"] if path.stem in ("05_export", "px4_odometry") else []  # they need none
    monkeypatch.setattr(sys, "argv", [str(path), *words])
    with pytest.raises(SystemExit, match=r"\Ausage: python .+\Z"):
        runpy.run_path(str(path), run_name="__main__")


@pytest.mark.parametrize(
    ("name", "words", "package", "remedy"),
    [
        ("to_gsplat", "seen.parquet out", "pyarrow", "pip install pyarrow"),
        ("hloc_queries", "a b c d e f 0.03", "pycolmap", "pip install pycolmap"),
        ("px4_odometry", "ned", "rclpy", "pip install 'rs_localizer[ros]'"),
        ("px4_odometry", "ned", "px4_msgs", "PX4's release"),
    ],
)
def test_a_missing_package_is_said_in_a_line(name, words, package, remedy, tmp_path):
    if package == "px4_msgs":
        pytest.importorskip("rclpy")
    missing = f"raise ModuleNotFoundError(\"No module named '{package}'\", name='{package}')\n"
    (tmp_path / f"{package}.py").write_text(missing)
    done = started(f"python {EXAMPLES}/{name}.py {words}", tmp_path, PYTHONPATH=str(tmp_path))
    assert done.returncode == 1
    assert done.stderr.startswith(f"{name}.py: the package {package} is not installed: ")
    assert remedy in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_file_that_is_not_there_is_said_in_a_line(tmp_path):
    done = started(f"python {EXAMPLES}/to_gsplat.py none.parquet out", tmp_path)
    assert done.stderr == "to_gsplat.py: there is no file none.parquet\n"


FILES = {
    "config.json": """{"resolution": {"width": 640.0, "height": 480.0}, "cameraIntrinsics":
        {"rows": 3, "cols": 3, "type": 6, "data": [500.0, 0, 320.5, 0, 510.0, 240.5, 0, 0, 1]},
        "distCoeffs": {"rows": 1, "cols": 8, "data": [1, 2, 3, 4, 0, 0, 0, 0]},
        "calobjectSize": {"width": 7.0, "height": 7.0}, "lensmodel": "LENSMODEL_OPENCV"}""",
    "field.json": """{"tags": [{"ID": 7, "pose": {"translation": {"x": 1.0, "y": 0.0, "z": 2.0},
        "rotation": {"quaternion": {"W": 0.0, "X": 0.0, "Y": 0.0, "Z": 1.0}}}}],
        "field": {"length": 16.0, "width": 8.0}}""",
}


def test_both_files_are_read_as_their_programs_mean_them(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "examples").symlink_to(EXAMPLES)
    said = [started(line, tmp_path) for line in commands("from_frc.py")]
    assert [done.stdout for done in said] == ["camera.json: a camera\n", "field.yaml: 1 tags\n"]
    lens = rsl.read_calibration(str(tmp_path / "camera.json"))
    np.testing.assert_array_equal(lens.D[:5], [1, 2, 3, 4, 0])
    assert not lens.D[5:].any()
    np.testing.assert_array_equal(lens.K[0], [500.0, 0.0, 320.5])
    # The tag looks back along x; up is z, and to the right of who looks at it is -y.
    (marker,) = read_marker_map(str(tmp_path / "field.yaml")).markers
    expected = [[1.0, 0.08255, 2.08255], [1.0, -0.08255, 2.08255]]
    np.testing.assert_allclose(marker.corners[:2], expected, rtol=0.0, atol=1e-9)


def ran(name: str, capsys: pytest.CaptureFixture[str]) -> str:
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def test_one_image(capsys):
    said = ran("01_localize.py", capsys)
    found = dict(re.findall(r"^([\w ]+ \(.*?\)) \[(.*?)\]", said, re.MULTILINE))
    values = {name: np.array(text.split(), float) for name, text in found.items()}
    assert np.linalg.norm(values["position (m)"]) < 0.02
    assert np.linalg.norm(values["angular velocity (rad/s)"] - [0.4, 1.0, -0.3]) < 0.3
    # A velocity of a single image says little without its deviation.
    deviations = re.findall(r"^velocity .*?\] \+- \[(.*?)\]", said, re.MULTILINE)[0]
    off = values["velocity (m/s)"] - [0.5, 0.2, 0.3]
    assert np.all(np.abs(off) < 3.0 * np.array(deviations.split(), float))


def test_a_video(capsys):
    said = ran("02_track.py", capsys)
    count, millimetres = re.findall(r"(\d+) of 30 frames, ([\d.]+) mm off", said)[0]
    assert int(count) >= 28
    assert float(millimetres) < 10.0
    assert said.count("tracked") >= 25


def test_a_rig(capsys):
    said = ran("04_rig.py", capsys)
    (both,) = re.findall(r"both: ([\d.]+) mm", said)
    assert float(both) < 15.0
    alone = re.findall(r"one camera: ([\d.]+) mm", said)
    assert not alone or float(alone[0]) > float(both)


def test_an_export(tmp_path, capsys):
    pytest.importorskip("pyarrow", exc_type=ImportError)
    files = {row: tmp_path / f"{row}.txt" for row in ("first_row", "last_row")}
    module = runpy.run_path(str(EXAMPLES / "05_export.py"))
    for row, file in files.items():
        webcam = str(data.path(data.WEBCAM))
        module["main"](webcam, row, str(file), "readout_time:=0.011", "tracking:=false")
    first, last = map(read_tum, files.values())
    assert len(first) == len(last) > 100
    np.testing.assert_allclose((last.stamps_ns - first.stamps_ns) * 1e-9, 0.011, atol=1e-6)


def test_the_matcher_is_short_and_every_example_is_listed():
    code = (EXAMPLES / "03_node_client.py").read_text().partition("rclpy.init(")[2]
    assert 10 < len([line for line in code.splitlines() if line.strip()]) <= 25
    listed = (EXAMPLES / "README.md").read_text()
    for file in EXAMPLES.glob("*.*"):
        assert file.name == "README.md" or file.name in listed or file.suffix == ".cpp", file
        assert len(file.read_text().splitlines()) <= 120, file
