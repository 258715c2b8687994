# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Small files that stand for much work or memory, or lie about it: one sentence, at once."""

import os
import shutil
import sqlite3
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rs_localizer.io.bags import BagError, open_bag
from rs_localizer.io.images import decode_image
from rs_localizer.io.maps.files import read_map_file
from rs_localizer.io.maps.landmarks import MapError, make_map
from rs_localizer.io.messages import MessageError
from rs_localizer.io.video import Video, VideoError

ROOT = Path(__file__).parents[2]
MOST_MEGABYTES = 250.0
# Of this program, unlike ru_maxrss, which begins with that of the one that started it.
PEAK = "print(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])"
# Whatever goes wrong, it does not take the memory of others.
COMMAND = f"""
import re, resource, sys
resource.setrlimit(resource.RLIMIT_DATA, (2**29 + 2**30,) * 2)
from rs_localizer.__main__ import run
code = run()
{PEAK}
"""
COLMAP = Path(__file__).parent / "maps" / "colmap"
IMU = "sensor_msgs/msg/Imu"


@pytest.fixture(autouse=True)
def in_time() -> Iterator[None]:
    started = time.process_time()
    yield
    assert time.process_time() - started < 20.0


def test_a_stream_of_images_that_claim_too_much(tmp_path):
    size = b"\x00\x11\x08" + struct.pack(">HH", 65000, 65000) + b"\x03" + bytes(9)
    image = b"\xff\xd8\xff\xc0" + size + b"\xff\xda\x00\x02" + bytes(20) + b"\xff\xd9"
    (tmp_path / "a.mjpeg").write_bytes(image * 3)
    with pytest.raises(VideoError, match=r"no (image|stream of images) that can be"):
        list(Video(tmp_path / "a.mjpeg"))


def test_a_view_in_the_place_of_descriptors(tmp_path):
    shutil.copytree(COLMAP / "binary", tmp_path / "model")
    endless = (
        "CREATE VIEW descriptors AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n)"
        " SELECT x AS image_id, 0 AS type, 1 AS rows, 128 AS cols, x AS data FROM n WHERE x < 0"
    )
    with sqlite3.connect(tmp_path / "model" / "database.db") as tables:
        tables.execute(endless)
    tables.close()
    with pytest.raises(MapError, match="of 0 kinds"):
        read_map_file(tmp_path / "model", "map")


def test_recordings_with_types_of_their_own(tmp_path):
    own = get_typestore(Stores.EMPTY)
    own.register(get_types_from_msg("float64[] angular_velocity_covariance\n", IMU))
    with Writer(tmp_path / "bag", version=9) as writer:
        connection = writer.add_connection("/imu", IMU, typestore=own)
        message = own.types[IMU](angular_velocity_covariance=np.zeros(2))
        writer.write(connection, 1, own.serialize_cdr(message, IMU))
    with (
        open_bag(tmp_path / "bag") as bag,
        pytest.raises(BagError, match="describes sensor_msgs/msg/Imu otherwise than ROS 2"),
    ):
        list(bag.messages(["/imu"]))


def said(code: str, *words: str | Path) -> str:
    """What a process says that ends in time, with no more memory than it may have."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, *map(str, words)], text=True, timeout=300, check=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    text, _, kilobytes = done.stdout.strip().rpartition("\n")
    assert float(kilobytes) / 1e3 < MOST_MEGABYTES, text
    return text


@pytest.mark.parametrize("suffix", ["yaml", "npz", "json"])
def test_files_without_an_end(tmp_path, suffix):
    (tmp_path / f"a.{suffix}").symlink_to("/dev/zero")
    fault = "no plain file" if suffix == "npz" else "it has more than 20000000 characters"
    assert fault in said(COMMAND, "map", "info", tmp_path / f"a.{suffix}")


def test_a_pipe_without_an_end(tmp_path):
    os.mkfifo(tmp_path / "pipe.yaml")
    with subprocess.Popen(["sh", "-c", f"yes > {tmp_path}/pipe.yaml"]) as yes:
        assert "it has more than 20000000 char" in said(
            COMMAND, "map", "info", tmp_path / "pipe.yaml"
        )
        yes.kill()


def png(size: int, bits: int) -> bytes:
    row = bytes(1 + size * bits // 8)
    packer = zlib.compressobj(9)
    data = b"".join(packer.compress(row) for _ in range(size)) + packer.flush()

    def chunk(kind: bytes, body: bytes) -> bytes:
        return (
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        )

    depth, color = (1, 0) if bits == 1 else (16, 6)
    about = struct.pack(">IIBBBBB", size, size, depth, color, 0, 0, 0)
    start = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", about)
    return start + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def progressive(size: int) -> bytes:
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    return cv2.imencode(".jpg", np.zeros((size, size), np.uint8), options)[1].tobytes()


@pytest.mark.parametrize("image", [png(12_000, 1), png(8_000, 64), progressive(6_000)])
def test_images_that_are_all_alike(image, monkeypatch):
    """They are refused by their headers."""
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(MessageError, match=r"says that it is (12000|8000|6000) x .*, too much for"):
        decode_image(image, "")


@pytest.mark.parametrize("image", [png(2_000, 1), png(1_900, 64), progressive(1_900)])
def test_small_images_may_be_all_alike(image):
    assert not decode_image(image, "").any()


@pytest.mark.parametrize("value", [-1e-6, -np.inf, np.inf])
def test_covariances_of_no_map(tmp_path, value):
    covariances = np.tile(np.eye(3), (2, 1, 1))
    covariances[1, 2, 2] = value
    np.savez(tmp_path / "map.npz", points=np.ones((2, 3)), ids=[1, 2], covariances=covariances)
    with pytest.raises(MapError, match="finite variances of 0 or more"):
        read_map_file(tmp_path / "map.npz", "map")


def test_covariances_that_nobody_knows():
    unknown = np.full((2, 3, 3), np.nan)
    assert len(make_map(np.ones((2, 3)), np.array([1, 2]), None, "map", unknown).points) == 2
