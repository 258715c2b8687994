# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags of `simulate` hold frames and their truth; `evaluate` finds errors of known size."""

import json
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
from rs_localizer.io.trajectories import Trajectory, Twists, write_tum, write_twists
from rs_localizer.settings import load_params_file, write_parameters

TURN = ("--angular-velocity", "0.5", "-1", "2", "--linear-velocity", "0.2", "0", "0")
SHORT = ("--duration", "1", "--points", "60")


def simulate(out: Path, *words: str) -> int:
    return main(["simulate", str(out), *words])


@pytest.mark.parametrize(
    ("topic", "words"), [("/correspondences", []), ("/image_raw/compressed", ["--images"])]
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


def test_lens_and_shutter_of_a_file_go_on_to_the_next_command(tmp_path, monkeypatch, capsys):
    """An option takes one of them back."""
    monkeypatch.chdir(tmp_path)
    K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
    lens = Camera(640, 480, K, [-0.2, 0.05, 0.001, -0.001])
    shutter = {"readout_time": 0.025, "scan_direction": "left_to_right"}
    write_parameters(Path("camera.yaml"), shutter, lens_parameters(lens))
    words = ("--camera", "camera.yaml", "--scan-direction", "bottom_to_top", "--duration", "0.2")
    assert simulate(Path("my bag"), *words) == 0
    *_, line = capsys.readouterr().out.splitlines()
    assert line.startswith("next: ")
    command = shlex.split(line.split("rs_localizer ", 1)[1])
    assert load_params_file(tmp_path / "my bag" / "parameters.yaml") == {
        "readout_time": 0.025,
        "scan_direction": "bottom_to_top",
    }
    with open_bag(Path("my bag")) as bag:
        info = read_camera_info(next(m for _, _, m in bag.messages(["/camera_info"])))
    assert info.D[:4] == tuple(lens.D)
    assert main(command) == 0
    assert main(["evaluate", "my bag_poses", "my bag"]) == 0


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
