# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer calibrate``, ``readout`` and ``replay --smooth``: the real recording, faults."""

import itertools
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from recorded import record

from rs_localizer import data
from rs_localizer.cli.commands import main
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.camera_files import read_calibration
from rs_localizer.io.trajectories import read_tum
from rs_localizer.settings import load_params_file

MOVING = "--trajectory tum_vi_room5 --duration 3 --points 60 --noise 0.5 --readout-time 0.02"


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("flight") / "flight"
    assert main(["simulate", str(out), *MOVING.split()]) == 0
    return out


def test_the_webcam(tmp_path, ran):
    """Its images have no times of their own: the readout time is refused, the lens is written."""
    half, out = tmp_path / "half", tmp_path / "webcam.yaml"
    with open_bag(data.path(data.WEBCAM)) as bag, BagWriter(half) as copy:
        for topic, stamp_ns, message in itertools.islice(bag.messages(tuple(bag.topics)), 180):
            copy.write(topic, message, stamp_ns)
    words = ["calibrate", str(half), "--out", str(out), "--intrinsics"]
    said = ran(*words, "--camera-info", tmp_path / "lens.yaml", code=1)
    assert "off their stamps" in said.err
    assert "not written: readout time and scan direction" in said.err
    values = load_params_file(out)
    assert "readout_time" not in values
    camera = read_calibration(out)
    assert camera.K[0, 0] == pytest.approx(529.0, rel=0.02)
    np.testing.assert_allclose(read_calibration(tmp_path / "lens.yaml").D, camera.D)


def test_a_simulated_flight_against_the_assumed_direction(flight, tmp_path, ran):
    """Parts have the sense of the direction that is told: positive."""
    out = tmp_path / "camera.yaml"
    words = ["-p", "scan_direction:=bottom_to_top", "-p", "stamp_offset:=0.001", "--out", str(out)]
    parts = re.findall(r" to +[\d.]+ s +([-+][\d.]+) \+- ", ran("calibrate", flight, *words).out)
    assert parts
    assert all(10.0 < float(part) < 30.0 for part in parts), parts
    values = load_params_file(out)
    assert values["scan_direction"] == "top_to_bottom"
    assert values["stamp_offset"] == 0.001
    assert abs(values["readout_time"] - 0.02) < 4.0 * values["readout_time_deviation"]


def test_an_imu(flight, tmp_path, capsys):
    """Its stamps are 5 ms early."""
    bag, out = tmp_path / "bag", tmp_path / "camera.yaml"
    record(bag, *MOVING.split(), "--imu", "--imu-offset", "0.005")
    assert main(["calibrate", str(bag), "--imu", "--out", str(out)]) == 0
    # 3 s of slow motion
    assert load_params_file(out)["imu.time_offset"] == pytest.approx(5e-3, abs=1e-3)
    said = capsys.readouterr().out
    assert "rotation camera <- imu" in said
    assert "gyroscope bias" in said
    assert main(["calibrate", str(bag), "--imu", "-r", "imu:=/nothing"]) == 1
    assert "/nothing does not exist" in capsys.readouterr().err
    assert main(["calibrate", str(flight), "--imu"]) == 1
    assert "has no topic of type sensor_msgs/msg/Imu" in capsys.readouterr().err


def test_faults(flight, tmp_path, ran):
    video = tmp_path / "video.mjpeg"
    video.write_bytes(2 * cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))[1].tobytes())
    board = ["--board", "5x4", "--square", "0.1"]
    for code, words in (
        (1, [str(tmp_path / "none")]), (2, [str(flight), "--out", str(tmp_path / "x.txt")]),
        (2, [str(flight), *board]), (2, [str(video), *board]),
    ):  # fmt: skip
        assert main(["calibrate", *words]) == code
    earlier = tmp_path / "earlier.yaml"
    earlier.write_text("mine")
    lens = tmp_path / "other_camera_info.yaml"
    lens.touch()
    for words, text in (
        (["--out", str(earlier)], f"{earlier} exists; choose another OUT, or --overwrite"),
        (["--out", str(earlier / "a.yaml")], "a.yaml cannot be written: Not a directory"),
        (["--out", str(tmp_path / "other.yaml"), "--camera-info", str(lens)], f"{lens} exists"),
    ):
        told = ran("calibrate", flight, *words, code=1)  # before the work
        assert text in told.err
        assert told.out == ""
    assert earlier.read_text() == "mine"


def test_what_a_lens_is_off_by_stays_with_it(flight, tmp_path):
    """Found with one recording, and the shutter anew with another."""
    lens, both = tmp_path / "lens.yaml", tmp_path / "both.yaml"
    assert main(["calibrate", str(flight), "--intrinsics", "--out", str(lens)]) == 0
    assert main(["calibrate", str(flight), "--camera", str(lens), "--out", str(both)]) == 0
    off = [
        {name: value for name, value in load_params_file(file).items() if "calibration." in name}
        for file in (lens, both)
    ]
    assert len(off[0]) == 4
    assert off[0] == off[1]


def test_smooth(flight, tmp_path, ran):
    out, words = tmp_path / "out", ["replay", str(flight), "--smooth", "--out"]
    params = ["--params", str(flight / "parameters.yaml")]
    assert main([*words, str(out), *params, "--pose-rate", "200"]) == 0
    assert np.diff(read_tum(out / "poses.txt").stamps_ns).min() == pytest.approx(5e6, abs=2)
    assert (out / "bridged.txt").read_text() == ""
    assert "--smooth needs the readout time" in ran(*words, tmp_path / "none", code=1).err
