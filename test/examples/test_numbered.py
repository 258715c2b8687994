# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The numbered examples run as they are, and find what is true."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from rs_localizer import data
from rs_localizer.io.trajectories import read_tum

EXAMPLES = Path(__file__).parents[2] / "examples"


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
