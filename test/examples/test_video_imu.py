# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A video as Insta360's cameras write it: its gyroscope becomes a topic in camera axes."""

import struct
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typed_commands import EXAMPLES, started

pytest.importorskip("telemetry_parser", reason="needs telemetry-parser (rs_localizer[examples])")

from video_imu import CAMERA_FROM_SENSOR

from rs_localizer import data
from rs_localizer.io.bags import open_bag
from rs_localizer.io.imu import read_imu


def field(tag: int, value: int | float | str | bytes) -> bytes:
    """A field of a message of protobuf."""

    def varint(number: int) -> bytes:
        low = number & 0x7F
        return bytes([low | 0x80]) + varint(number >> 7) if number > 0x7F else bytes([low])

    if isinstance(value, int):
        return varint(8 * tag) + varint(value)
    if isinstance(value, float):
        return varint(8 * tag + 1) + struct.pack("<d", value)
    data = value.encode() if isinstance(value, str) else value
    return varint(8 * tag + 2) + varint(len(data)) + data


def insta360(readings: bytes, *about: bytes) -> bytes:
    """What Insta360 appends to a video, as telemetry-parser's source describes it.

    Args:
        readings: rows of ms, three of the accelerometer, three of the gyroscope.
        about: fields of the camera.
    """
    records = b""
    for kind, style, part in ((3, 0, readings), (1, 1, b"".join(about))):
        records += part + struct.pack("<BBI", style, kind, len(part))
    end = bytes(32) + struct.pack("<II", len(records) + 72, 3)
    return records + end + b"8db42d694ccc418790edff439fe026bf"


# telemetry-parser turns the axes of a GO 3 by a quarter since 0.3.
_NEW_AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def add_telemetry(path: Path, seconds: Any, rates: Any, readout: float) -> None:
    """Append the gyroscope, rates (n,3) in the camera's axes at times (n,), to a video."""
    new = metadata.version("telemetry-parser") >= "0.3"
    sensor = np.asarray(rates) @ (_NEW_AXES if new else np.eye(3)) @ CAMERA_FROM_SENSOR
    milliseconds = np.round(1e3 * np.asarray(seconds) + 1000).astype(int).tolist()
    rows = zip(milliseconds, sensor.tolist(), strict=True)
    readings = b"".join(struct.pack("<Q6d", t, 1.0, 0.0, 0.0, *rate) for t, rate in rows)
    about = field(2, "Insta360 GO 3"), field(24, 1000), field(25, 1e3 * readout)
    with path.open("ab") as file:
        file.write(insta360(readings, *about))


def test_readings_stand_beside_what_was_seen_in_the_axes_of_the_camera(tmp_path):
    video, seen = tmp_path / "video.mp4", data.path(data.WEBCAM)
    video.write_bytes(b"\0\0\0\x14ftypisom")
    seconds, rates = np.arange(0.0, 1.0, 0.005), np.array([[0.1, -0.5, 0.3]]) * np.ones((200, 1))
    add_telemetry(video, seconds, rates, 0.016)
    out = tmp_path / "out"
    done = started(f"python {EXAMPLES}/video_imu.py {video} {seen} {out}", tmp_path)
    assert (done.stdout, done.stderr) == (f"{out}: 200 readings\n", "")
    with open_bag(out) as bag, open_bag(seen) as before:
        assert bag.count(before.topics) == before.count(before.topics)
        readings = [read_imu(message) for _, _, message in bag.messages(["/imu"])]
    found = np.array([reading.angular_velocity for reading in readings])
    np.testing.assert_allclose(found, rates, rtol=0.0, atol=1e-6)
    stamps = np.array([reading.stamp_ns for reading in readings])
    np.testing.assert_array_equal(stamps, 10**9 + np.round(seconds * 1e9).astype(int))
    assert (out / "parameters.yaml").read_text() == (seen / "parameters.yaml").read_text()
