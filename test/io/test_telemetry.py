# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Gyroscopes and readout times inside videos: axes, units, clock, and what is said of them."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("telemetry_parser", reason="needs telemetry-parser (rs_localizer[video])")

from recorded import field

from rs_localizer.cli import image_input
from rs_localizer.cli.commands import main
from rs_localizer.io import telemetry as files
from rs_localizer.io.bags import open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.telemetry import (
    Telemetry,
    TelemetryError,
    has_telemetry,
    interpreted,
    read_telemetry,
)
from rs_localizer.io.telemetry_process import extract
from rs_localizer.settings import load_params_file

RATE = 200.0


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A log of gyroflow: a camera upright, that turns about the vertical, then about its axis."""
    lines = [
        "GYROFLOW IMU LOG", "version,1.3", "id,tester", "orientation,XYZ", "tscale,0.001",
        "gscale,1", "ascale,1", "frame_readout_time,20.5", "t,gx,gy,gz,ax,ay,az",
    ]  # fmt: skip
    for k in range(400):
        turn = (0.5, 0.0, 0.0) if k < 200 else (0.0, 0.1, 0.3)
        lines.append(",".join(map(str, (1000 * k / RATE, *turn, 1.0, 0.0, 0.0))))
    path = tmp_path / "log.gcsv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_readings_are_in_the_axes_of_the_camera(log):
    found = read_telemetry(log)
    assert (found.rate, len(found.times), found.times[0]) == (pytest.approx(RATE), 400, 0.0)
    assert found.readout_time == pytest.approx(0.0205)
    assert found.stabilizer == ""
    # telemetry-parser has x up: gravity pulls along +y of the camera, the table pushes along -y.
    np.testing.assert_allclose(found.forces[0], [0.0, -9.80665, 0.0], atol=1e-9)
    np.testing.assert_allclose(found.rates[0], [0.0, -0.5, 0.0], atol=1e-9)
    np.testing.assert_allclose(found.rates[-1], [-0.1, 0.0, -0.3], atol=1e-9)


def test_what_cannot_be_read_is_named(tmp_path):
    path = tmp_path / "broken.mp4"
    path.write_bytes(b"gpmd" + bytes(100))
    assert has_telemetry(path)
    with pytest.raises(TelemetryError, match=r"broken\.mp4: its telemetry cannot be read"):
        read_telemetry(path)
    path.write_bytes(bytes(2**20))
    assert not has_telemetry(path)


def test_a_panic_of_the_library_is_an_error_with_a_name(log):
    """A log whose times cannot be read: Rust's ``unwrap``, whose panic is no Exception."""
    log.write_text(log.read_text().replace("tscale,0.001", "tscale,soon"))
    with pytest.raises(TelemetryError, match=r"log\.gcsv: its telemetry cannot be read \(ffmpeg"):
        read_telemetry(log)


def test_a_small_file_gets_little_memory(tmp_path):
    """A trailer of 178 bytes that says that it is 4.2 GB long."""
    record = field(2, "X")
    trailer = record + struct.pack("<BBI", 1, 1, 2**32 - 100)
    path = tmp_path / "bomb.insv"
    path.write_bytes(bytes(60) + trailer + bytes(32) + struct.pack("<II", 2**32 - 8, 3)
                     + b"8db42d694ccc418790edff439fe026bf")  # fmt: skip
    with pytest.raises(TelemetryError, match=r"bomb\.insv: its telemetry cannot be read"):
        read_telemetry(path)


def readings(**changes: Any) -> dict[str, Any]:
    """Of a hundred readings, as the process leaves them."""
    gyroscope = np.column_stack([5.0 * np.arange(100), np.full((100, 3), 10.0)])
    said = {"name": "X", "values": changes.pop("values", {})}
    arrays = {"gyroscope": gyroscope, "accelerometer": np.zeros((0, 4)), "turns": np.zeros((0, 5))}
    return arrays | {"said": json.dumps(said)} | changes


def test_numbers_that_no_gyroscope_gives():
    some = readings()["gyroscope"]
    some[[3, 7], [1, 0]] = np.nan, 4.0  # a reading, and a time that falls
    found = interpreted(readings(gyroscope=some))
    assert len(found.times) == 98
    assert np.all(np.diff(found.times) > 0.0)
    with pytest.raises(TelemetryError, match="of 100 readings of the gyroscope, 99 are no numbers"):
        interpreted(readings(gyroscope=some * [-1.0, 1.0, 1.0, 1.0]))
    with pytest.raises(TelemetryError, match="100 are no numbers"):
        interpreted(readings(gyroscope=some + 1e5))


def test_a_readout_time_of_another_type():
    assert interpreted(readings(values={"frame_readout_time": "soon"})).readout_time is None


def dji(tags: list[Any], samples: Any = list) -> Telemetry | None:
    """What is made of what telemetry-parser would say of a file of DJI."""
    parser = SimpleNamespace(
        camera="DJI", model="Action 4", normalized_imu=samples, telemetry=lambda readable: tags
    )
    return interpreted(extract(parser))


def test_orientations_take_the_place_of_a_gyroscope():
    """As of DJI; a camera that turns to the right and then lifts its view."""
    times = 0.01 * np.arange(40)
    turns = [
        Rotation.from_rotvec([0.0, -0.5 * min(t, 0.2), 0.0])  # y is up
        * Rotation.from_rotvec([0.3 * max(0.0, t - 0.2), 0.0, 0.0])
        for t in times
    ]
    rows = [
        {"t": 1e3 * t, "v": dict(zip("xyzw", turn.as_quat(), strict=True))}
        for t, turn in zip(times, turns, strict=True)
    ]
    lens = {"Data": {"frame_readout_time": 9.0}}
    found = dji(
        [{"Quaternion": {"Data": rows[:20]}, "Lens": lens}, {"Quaternion": {"Data": rows[19:]}}]
    )
    np.testing.assert_allclose(found.times, times[:-1] + 0.005, atol=1e-9)
    np.testing.assert_allclose(found.rates[:20], np.tile([0.0, 0.5, 0.0], (20, 1)), atol=1e-9)
    np.testing.assert_allclose(found.rates[20:], np.tile([0.3, 0.0, 0.0], (19, 1)), atol=1e-9)
    assert np.isnan(found.forces).all()
    assert found.readout_time == pytest.approx(0.009)


def test_what_a_gopro_says_of_its_images():
    """By the names of GPMF's documentation: a HERO7's readout times are those of each image."""
    said = {"0x53524f54": 8.744, "0x45495345": "Y", "0x45495341": "N/A"}
    found = interpreted(readings(values=said))
    assert found.readout_time == pytest.approx(0.008744)
    assert found.stabilizer == "electronic stabilization"
    off = interpreted(readings(values=said | {"0x45495345": "N"}))
    assert off.stabilizer == ""
    high = interpreted(readings(values={"0x45495341": "HS HLevel"}))
    assert high.stabilizer == "HS HLevel"


def box(kind: bytes, content: bytes) -> bytes:
    """A box of MP4."""
    return struct.pack(">I4s", 8 + len(content), kind) + content


def test_tracks_of_a_long_video_are_far_from_both_ends(tmp_path):
    path = tmp_path / "GX010001.MP4"
    far = bytes(2**19)
    path.write_bytes(box(b"mdat", far) + box(b"moov", far + b"gpmd" + far))
    assert has_telemetry(path)
    path.write_bytes(box(b"mdat", far + b"gpmd" + far) + box(b"moov", far))
    assert not has_telemetry(path)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """A second of noise at 20 Hz that says that it has telemetry."""
    path = tmp_path / "ride.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 20.0, (160, 120))
    noise = np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)
    for k in range(20):
        writer.write(cv2.resize(np.roll(noise, k, 1), (160, 120), interpolation=cv2.INTER_NEAREST))
    writer.release()
    with path.open("ab") as file:
        file.write(b"\0\0\0\x0cfreegpmd")
    K = [[150, 0, 79.5], [0, 150, 59.5], [0, 0, 1]]
    (tmp_path / "camera.json").write_text(
        json.dumps({"K": K, "D": [0, 0, 0, 0], "width": 160, "height": 120})
    )
    return path


def detect(video: Path, *words: str) -> Path:
    out = video.parent / "seen"
    calibration = ["--calibration", str(video.parent / "camera.json")]
    found = ["detect", str(video), *calibration, "--features", "orb", "--out", str(out)]
    assert main([*found, "--overwrite", *words]) == 0
    return out


@pytest.fixture
def telemetry(log: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Gives the video the telemetry of the log, changed."""

    def give(**changes: Any) -> Telemetry:
        found = read_telemetry(log)
        changed = replace(found, **changes)
        monkeypatch.setattr(image_input, "read_telemetry", lambda path: changed)
        return changed

    return give


def test_detect_takes_gyroscope_and_readout_time(video, telemetry, capsys):
    telemetry()
    out = detect(video)
    assert ("gcsv tester: gyroscope at 200 Hz, readout time 20.50 ms\n") in capsys.readouterr().out
    assert load_params_file(out / "parameters.yaml")["readout_time"] == pytest.approx(0.0205)
    with open_bag(out) as bag:
        readings = [message for _, _, message in bag.messages(["/imu"])]
        images = [stamp_ns(message) for _, _, message in bag.messages(["/keypoints"])]
        frames = {m.header.frame_id for _, _, m in bag.messages(["/camera_info"])}
    assert {message.header.frame_id for message in readings} == frames
    stamps = np.array([stamp_ns(message) for message in readings])
    # The first image is at 1 s of the recording and at 0 of the video, as is the first reading.
    assert (images[0], stamps[0]) == (10**9, 10**9)
    np.testing.assert_allclose(np.diff(stamps), 5_000_000, atol=1)
    assert 190 <= len(stamps) <= 192  # until the last image, at 0.95 s
    assert readings[0].angular_velocity.y == pytest.approx(-0.5)


@pytest.mark.parametrize(
    ("changes", "words", "said"),
    [
        ({}, ["--rate", "50"], ""),  # slowed down: nobody knows when the readings were
        ({"stabilizer": "HS HLevel"}, [], "has stabilized this video (HS HLevel): its rows are"),
    ],
)
def test_where_the_gyroscope_says_nothing(video, telemetry, capsys, changes, words, said):
    telemetry(**changes)
    out = detect(video, *words)
    assert said in capsys.readouterr().out
    with open_bag(out) as bag:
        assert "/imu" not in bag.topics
    assert not (out / "parameters.yaml").exists() or "--rate" in words


def test_a_slower_accelerometer_is_read_at_the_times_of_the_gyroscope():
    """Both begin and end together, and forces that grow with time are those of then."""
    times = 3.0 + np.linspace(0.0, 2.0, 401)
    forces = np.linspace(0.0, 2.0, 101)[:, None] * (1.0, -2.0, 3.0)
    np.testing.assert_allclose(
        files._spread(forces, times), (times - 3.0)[:, None] * (1.0, -2.0, 3.0), atol=1e-12
    )
    assert np.isnan(files._spread(forces[:1], times)).all()
