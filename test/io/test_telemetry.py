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

from recorded import field, insta360

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


def test_a_file_of_insta360(tmp_path):
    """Its trailer, written by hand as telemetry-parser's source describes it."""
    size = 2560
    pair = field(1, size) + field(2, size)
    about = field(2, "Insta360 GO 3") + field(19, pair) + field(24, 1000) + field(25, 18.5)
    about += field(27, pair + field(3, size) + field(4, size))
    about += field(54, "1_2_2870_2870_1280_1290_0_0_0_0_0_0_0.05_-0.1_0.1_0_0_2560_2560_4_0")
    readings = b"".join(
        struct.pack("<Q6d", 1000 + 5 * k, 1.0, 0.0, 0.0, 0.5, 0.0, 0.1) for k in range(400)
    )
    path = tmp_path / "VID_1.insv"
    path.write_bytes(bytes(5000) + insta360(readings, about))
    assert has_telemetry(path)
    found = read_telemetry(path)
    assert found.camera == "Insta360 GO 3"
    assert found.readout_time == pytest.approx(0.0185)
    assert (found.rate, found.times[0]) == (pytest.approx(200.0), pytest.approx(0.0))
    # The library has x up, as in test_readings_are_in_the_axes_of_the_camera.
    np.testing.assert_allclose(found.rates[0], [0.0, -0.5, -0.1], atol=1e-9)
    np.testing.assert_allclose(found.forces[0], [0.0, -9.80665, 0.0], atol=1e-3)


def box(kind: str, *parts: bytes) -> bytes:
    """A box of MP4."""
    return struct.pack(">I4s", 8 + sum(map(len, parts)), kind.encode()) + b"".join(parts)


def klv(key: str, kind: str, values: Any, width: int = 1) -> bytes:
    """An item of GPMF: what it is, its type, the size of a value, how many, the values."""
    kinds = {"L": ">u4", "f": ">f4", "s": ">i2"}
    data = values.encode() if kind == "c" else np.asarray(values, kinds[kind]).tobytes()
    size = width * (1 if kind == "c" else np.dtype(kinds[kind]).itemsize)
    head = key.encode() + struct.pack(">cBH", kind.encode(), size, len(data) // size)
    return head + data + bytes(-len(data) % 4)


def nest(key: str, *items: bytes) -> bytes:
    data = b"".join(items)
    return key.encode() + struct.pack(">BBH", 0, 1, len(data)) + data


def of_gopro(payloads: list[bytes], *settings: bytes, padding: int = 0) -> bytes:
    """An MP4 with a track of GPMF, a payload a second, and the settings of the camera."""
    count, first = len(payloads), box("ftyp", b"mp41")
    places = len(first) + 8 + np.cumsum([0, *map(len, payloads)])[:-1]
    length = struct.pack(">4I", 0, 0, 1000, 1001 * count)
    tables = box(
        "stbl",
        box("stsd", struct.pack(">2I", 0, 1), box("gpmd", bytes(7), b"\1")),
        box("stts", struct.pack(">4I", 0, 1, count, 1001)),
        box("stsc", struct.pack(">5I", 0, 1, 1, 1, 1)),
        box("stsz", struct.pack(f">{3 + count}I", 0, 0, count, *map(len, payloads))),
        box("stco", struct.pack(f">{2 + count}I", 0, count, *places.tolist())),
    )
    track = box(
        "trak",
        box("tkhd", struct.pack(">6I", 15, 0, 0, 1, 0, 1001 * count), bytes(60)),
        box("mdia", box("mdhd", bytes(4), length, bytes(4)),
            box("hdlr", bytes(8), b"meta", bytes(12), b"GoPro MET\0"), box("minf", tables)),
    )  # fmt: skip
    about = box("udta", box("GPMF", nest("DEVC", klv("DVID", "L", 1), *settings)))
    content = box("mvhd", bytes(4), length, bytes(80)), about, box("free", bytes(padding)), track
    return first + box("mdat", *payloads) + box("moov", *content, box("free", bytes(padding)))


def test_a_file_of_gopro(tmp_path):
    """As GPMF's documentation has it: up, right to left, forward to back; a HERO7's readout times
    stand in a stream of their own.
    """
    rates, forces = np.tile([500, 0, 100], (200, 1)), np.tile([4096, 0, 0], (200, 1))
    payload = nest(
        "DEVC", klv("DVID", "L", 1), klv("DVNM", "c", "Hero7 Black"),
        nest("STRM", klv("SIUN", "c", "m/s2"), klv("SCAL", "s", 418), klv("ACCL", "s", forces, 3)),
        nest("STRM", klv("SIUN", "c", "rad/s"), klv("SCAL", "s", 1000), klv("GYRO", "s", rates, 3)),
        nest("STRM", klv("STNM", "c", "Sensor read out time"), klv("SROT", "f", [8.744] * 30)),
    )  # fmt: skip
    settings = klv("MINF", "c", "HERO7 Black"), klv("VFOV", "c", "W"), klv("EISE", "c", "N")
    path = tmp_path / "GX010001.MP4"
    # As of half an hour: what the track is called is far from both ends.
    path.write_bytes(of_gopro(3 * [payload], *settings, padding=2**19))
    assert has_telemetry(path)
    found = read_telemetry(path)
    assert (found.camera, found.stabilizer) == ("GoPro HERO7 Black", "")
    assert found.readout_time == pytest.approx(0.008744)
    assert found.rate == pytest.approx(200.0, rel=2e-3)
    np.testing.assert_allclose(found.rates, np.tile([0.0, -0.5, -0.1], (600, 1)), atol=1e-6)
    np.testing.assert_allclose(found.forces[0], [0.0, -4096 / 418, 0.0], atol=1e-6)
    path.write_bytes(of_gopro([payload], *settings[:2], klv("EISE", "c", "Y"), padding=0))
    read_telemetry.cache_clear()
    stabilized = read_telemetry(path)
    assert stabilized.stabilizer == "electronic stabilization"


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
