# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""simulate --imu, and replay with it: what is recorded, which topic is found, what is said."""

import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from rs_localizer.cli.main import main
from rs_localizer.io.bags import open_bag
from rs_localizer.io.imu import read_imu
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.transforms import TransformTree

TURN = ("--angular-velocity", "0.5", "-1", "2", "--linear-velocity", "0.2", "0", "0")
CLEAN = (
    "--gyroscope-noise", "0", "--gyroscope-bias", "0", "--gyroscope-bias-walk", "0",
    "--accelerometer-noise", "0", "--accelerometer-bias", "0",
)  # fmt: skip


def simulate(out: Path, *words: str) -> int:
    return main(["simulate", str(out), "--duration", "1", "--points", "60", *words])


def test_a_recording_holds_readings_and_where_they_were_taken(tmp_path):
    assert simulate(tmp_path / "bag", *TURN, "--imu", *CLEAN, "--imu-offset", "0.004") == 0
    with open_bag(tmp_path / "bag") as bag:
        assert bag.topics["/imu"] == "sensor_msgs/msg/Imu"
        messages = list(bag.messages(["/imu", "/correspondences", "/camera_info"]))
        tree = TransformTree()
        for _, _, message in bag.messages(["/tf_static"]):
            tree.add(message, static=True)
    counts = Counter(topic for topic, _, _ in messages)
    assert counts["/correspondences"] == counts["/camera_info"] == 30
    assert counts["/imu"] >= 400
    mounting = tree.lookup("camera_optical_frame", "imu_link", None)
    np.testing.assert_allclose(mounting.translation, [0.03, -0.02, -0.01])
    for topic, recorded_ns, message in messages:
        delay = 1e-9 * (recorded_ns - stamp_ns(message))
        if topic != "/imu":  # comes when its last row has been read
            assert delay == pytest.approx(0.03)
            continue
        assert delay == pytest.approx(0.004)  # and the clock of the IMU is slow
        reading = read_imu(message)
        turn = mounting.rotation @ np.array(reading.angular_velocity)
        np.testing.assert_allclose(turn, [0.5, -1.0, 2.0], atol=1e-9)
        assert 9.0 < np.linalg.norm(reading.linear_acceleration or 0.0) < 10.6
    stamps = [recorded_ns for _, recorded_ns, _ in messages]
    assert stamps == sorted(stamps)


def test_replay_uses_it_and_says_so(tmp_path, capsys):
    assert simulate(tmp_path / "bag", *TURN, "--imu") == 0
    replay = ["replay", str(tmp_path / "bag"), "-p", "readout_time:=0.03"]
    capsys.readouterr()
    poses = []
    for name, words in (("both", []), ("alone", ["--no-imu"]), ("off", ["-p", "imu.use:=none"])):
        assert main([*replay, "--out", str(tmp_path / name), *words]) == 0
        said = capsys.readouterr().out
        assert ("localized with the IMU" in said) == (name == "both")
        if name == "both":
            assert re.search(r"localized with the IMU +(9\d\.\d|100\.0)%", said)
            assert re.search(r"time offset of the IMU \(ms\) +-?\d+\.\d\d", said)
        poses.append((tmp_path / name / "poses.txt").read_bytes())
    assert poses[0] != poses[1]
    assert poses[1] == poses[2]
    assert main([*replay, "--out", str(tmp_path / "n"), "--imu", "/nowhere"]) == 1
    assert "topic /nowhere does not exist" in capsys.readouterr().err
    assert main([*replay, "--out", str(tmp_path / "n"), "--imu", "/imu", "--no-imu"]) == 2
