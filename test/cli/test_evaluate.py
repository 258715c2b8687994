# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of known size come out of `evaluate`, whatever holds the poses."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.cli.commands import main
from rs_localizer.io.trajectories import Trajectory, Twists, write_tum, write_twists

STAMPS = 1_500_000_000_000_000_000 + np.arange(40, dtype=np.int64) * 33_333_333
RNG = np.random.default_rng(0)
TURNS = Rotation.from_quat(RNG.normal(size=(40, 4)))
TRUTH = Trajectory(STAMPS, np.cumsum(RNG.normal(size=(40, 3)), axis=0), TURNS.as_quat())
TWISTS = Twists(STAMPS, RNG.normal(size=(40, 3)), RNG.normal(size=(40, 3)))


@pytest.fixture
def files(tmp_path) -> Path:
    """Truth, and an estimate that is 0.1 m, 2 degrees, 0.05 rad/s and 0.5 m/s off."""
    off = TURNS * Rotation.from_rotvec([0.0, np.radians(2.0), 0.0])
    estimate = Trajectory(
        STAMPS + 400_000, TRUTH.positions + np.array([0.06, 0.0, 0.08]), off.as_quat()
    )
    for folder in ("replayed", "truth"):
        (tmp_path / folder).mkdir()
    write_tum(tmp_path / "truth.txt", TRUTH)
    write_tum(tmp_path / "truth" / "poses.txt", TRUTH)
    write_twists(tmp_path / "truth" / "twists.txt", TWISTS)
    write_tum(tmp_path / "replayed" / "poses.txt", estimate)
    twists = Twists(
        STAMPS,
        TWISTS.angular + np.array([0.03, 0.04, 0.0]),
        TWISTS.linear + np.array([0, 0.3, 0.4]),
    )
    write_twists(tmp_path / "replayed" / "twists.txt", twists)
    return tmp_path


def evaluate(files: Path, *words: str, estimate: str = "replayed") -> int:
    return main(["evaluate", str(files / estimate), str(files / "truth.txt"), *words])


def rows(text: str) -> dict[str, list[float]]:
    """Figures of each line of the table by its name."""
    found = re.findall(r"^([^\d\n]+?(?:\([^)]*\))?) {2,}((?:\s*[\d.]+)+)$", text, re.MULTILINE)
    return {name.strip(): [float(word) for word in figures.split()] for name, figures in found}


def test_table(files, capsys):
    picture = files / "errors.png"
    words = ["evaluate", str(files / "replayed"), str(files / "truth"), "--plot", str(picture)]
    assert main(words) == 0
    assert cv2.imread(str(picture)).shape[1] == 1300
    text = capsys.readouterr().out
    assert "40 of 40 poses compared" in text
    found = rows(text)
    for name, error in {
        "position (m)": 0.1,
        "orientation (deg)": 2.0,
        "angular velocity (deg/s)": np.degrees(0.05),
        "linear velocity (m/s)": 0.5,
    }.items():
        np.testing.assert_allclose(found[name], [40, error, error, error, error], atol=1e-4)


def test_frames_without_a_pose_are_told(files, tmp_path, capsys):
    few = TRUTH.part(np.arange(40) % 4 != 0)
    write_tum(tmp_path / "few.txt", few)
    assert evaluate(files, estimate="few.txt") == 0
    text = capsys.readouterr().out
    assert text.startswith("30 of 30 poses compared\n30 of 40 true poses have an estimate\n")


def test_ate_and_rpe(files, capsys):
    pytest.importorskip("evo", reason="the optional extra evo")
    assert evaluate(files, "--ate") == 0
    found = rows(capsys.readouterr().out)
    # A shift of all positions goes away in the alignment.
    np.testing.assert_allclose(found["ATE (m rms)"], [0.0], atol=1e-5)
    assert found["RPE, next frame (deg rms)"][0] < 4.0
    line = TRUTH.positions * [1.0, 0.0, 0.0]
    write_tum(files / "truth.txt", Trajectory(STAMPS, line, TRUTH.quaternions))
    assert evaluate(files, "--ate", estimate="truth.txt") == 1
    assert "positions on a line determine no alignment" in capsys.readouterr().err


def test_clocks_that_differ_are_named_and_figures_have_identifiers(files, tmp_path, capsys):
    late = Trajectory(STAMPS - 10**11, TRUTH.positions, TRUTH.quaternions)
    write_tum(tmp_path / "late.txt", late)
    assert evaluate(files, estimate="late.txt") == 1
    assert "1499999900.000 to 1499999901.300 s against 1500000000.000" in capsys.readouterr().err
    assert evaluate(files, "--json") == 0
    told = json.loads(capsys.readouterr().out)["result"]
    assert told["position_median_m"] == pytest.approx(0.1)
    assert all(key.isidentifier() for key in told)
