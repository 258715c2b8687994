# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The bag of `simulate`: what it holds, and that its truth is the truth of its frames."""

import shlex
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from rs_localizer.cli.main import main
from rs_localizer.io.bags import open_bag
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.messages import stamp_ns
from rs_localizer.settings import load_params_file


def simulate(out: Path, *words: str) -> int:
    return main(["simulate", str(out), *words])


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_bag_holds_frames_and_their_truth(tmp_path, storage):
    words = ("--duration", "0.5", "--storage", storage, "--readout-time", "0.02")
    assert simulate(tmp_path / "bag", *words) == 0
    with open_bag(tmp_path / "bag") as bag:
        assert bag.topics == {
            "/camera_info": "sensor_msgs/msg/CameraInfo",
            "/correspondences": "sensor_msgs/msg/PointCloud2",
            "/truth/pose": "geometry_msgs/msg/PoseStamped",
            "/truth/twist": "geometry_msgs/msg/TwistStamped",
        }
        messages = list(bag.messages(bag.topics))
    counts = Counter(topic for topic, _, _ in messages)
    assert messages[0][0] == "/camera_info"  # or the first frame would be lost
    frames = counts["/correspondences"]
    assert frames == 15
    assert counts == {
        "/camera_info": frames, "/correspondences": frames,
        "/truth/pose": 2 * frames, "/truth/twist": 2 * frames,
    }  # fmt: skip
    clouds = [m for topic, _, m in messages if topic == "/correspondences"]
    stamps = [stamp_ns(m) for m in clouds]
    assert stamps[0] == 1_000_000_000
    np.testing.assert_allclose(np.diff(stamps), 1e9 / 30, atol=2)
    # At the first row and at the middle one, so that either pose_time has its exact truth.
    truth = {stamp_ns(m) for topic, _, m in messages if topic == "/truth/pose"}
    assert truth == set(stamps) | {stamp + 10_000_000 for stamp in stamps}
    assert {m.header.frame_id for t, _, m in messages if t == "/truth/pose"} == {"map"}
    cameras = {m.header.frame_id for t, _, m in messages if t in ("/truth/twist", "/camera_info")}
    assert cameras == {"camera_optical_frame"}
    assert clouds[0].header.frame_id == "map"
    assert len(set(read_correspondences(clouds[0]).table["id"])) == 150


def test_the_next_command_has_the_shutter(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ("--readout-time", "0.025", "--scan-direction", "bottom_to_top", "--duration", "0.2")
    assert simulate(Path("my bag"), *words) == 0
    *_, line = capsys.readouterr().out.splitlines()
    label, program, *command = shlex.split(line)
    assert (label, program) == ("next:", "rs_localizer")
    assert load_params_file(tmp_path / "my bag" / "parameters.yaml") == {
        "readout_time": 0.025,
        "scan_direction": "bottom_to_top",
    }
    assert main(command) == 0
    assert main(["evaluate", "my bag_poses", "my bag"]) == 0
