# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings, texts and images of which few bytes stand for gigabytes: one sentence, 250 MB."""

import bz2
import contextlib
import gzip
import io
import os
import re
import sqlite3
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import lz4.frame
import numpy as np
import pytest
import rosbags.rosbag2.reader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from rs_localizer.core.camera import Camera
from rs_localizer.io import containers
from rs_localizer.io.bags import open_bag, typestore
from rs_localizer.io.images import decode_image
from rs_localizer.io.maps.files import read_map_file
from rs_localizer.io.maps.landmarks import MapError, make_map
from rs_localizer.io.messages import MessageError

ROOT = Path(__file__).parents[2]
IMAGE, TOPIC = "sensor_msgs/msg/CompressedImage", "/image/compressed"
BLOCK, UNPACKED = 2**24, 2**29
MOST_MEGABYTES = 250.0
# Of this program, unlike ru_maxrss, which begins with that of the one that started it.
PEAK = "print(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])"
# Whatever goes wrong, it does not take the memory of others.
LIMIT = f"resource.setrlimit(resource.RLIMIT_DATA, ({UNPACKED + 2**30},) * 2)"
READ = f"""
import re, resource, sys
{LIMIT}
from rs_localizer.io.bags import BagError, open_bag
try:
    with open_bag(sys.argv[1]) as bag:
        print(sum(1 for _ in bag.messages(bag.topics)), "messages")
except BagError as error:
    print(error)
{PEAK}
"""
COMMAND = f"""
import re, resource, sys
{LIMIT}
from rs_localizer.__main__ import run
code = run()
{PEAK}
"""


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


@cache
def packed(count: int = UNPACKED, before: bytes = b"") -> bytes:
    """Zeros, packed by Zstandard to 30 kB."""
    reader = vars(rosbags.rosbag2.reader)
    made = io.BytesIO()
    with (reader.get("zstd") or reader["zstandard"]).open(made, "wb") as file:
        file.write(before)
        for _ in range(count // BLOCK):
            file.write(bytes(BLOCK))
    return made.getvalue()


def bag(path: Path, data: bytes, mode: str = "none", storage: str = "SQLITE3") -> Path:
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage]) as writer:
        writer.write(writer.add_connection(TOPIC, IMAGE, typestore=store), 1, data)
    text = (path / "metadata.yaml").read_text()
    text = re.sub("compression_format:.*", "compression_format: zstd", text)
    (path / "metadata.yaml").write_text(
        re.sub("compression_mode:.*", f"compression_mode: {mode}", text)
    )
    return path


def messages(path: Path) -> Path:
    return bag(path / "bag", packed(), "message")


def messages_of_mcap(path: Path) -> Path:
    return bag(path / "bag", packed(), "MESSAGE", "MCAP")


def lone(path: Path) -> Path:
    return next(messages(path).glob("*.db3"))


def files(path: Path) -> Path:
    folder = bag(path / "bag", b"any")
    (file,) = folder.glob("*.db3")
    (folder / f"{file.name}.zstd").write_bytes(packed(before=file.read_bytes()))
    file.unlink()
    text = (folder / "metadata.yaml").read_text().replace(file.name, f"{file.name}.zstd")
    (folder / "metadata.yaml").write_text(text.replace("mode: none", "mode: file"))
    return folder


def lone_file(path: Path) -> Path:
    return next(files(path).glob("*.zstd"))


def altered(path: Path, script: str) -> Path:
    """A database whose tables another program has made."""
    (file,) = bag(path / "bag", b"any").glob("*.db3")
    with contextlib.closing(sqlite3.connect(file)) as tables:
        tables.executescript(script)
    return file


def computed(path: Path) -> Path:
    return altered(
        path,
        "DROP TABLE messages; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, "
        "timestamp INTEGER, data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL);"
        "INSERT INTO messages(topic_id, timestamp) VALUES (1, 1)",
    )


def endless(path: Path) -> Path:
    return altered(
        path,
        "DROP TABLE message_definitions; CREATE VIEW message_definitions AS WITH RECURSIVE "
        "n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT x AS id, '' AS topic_type, "
        "'ros2msg' AS encoding, '' AS encoded_message_definition, '' AS type_description_hash "
        "FROM n",
    )


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def text(value: str | bytes) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(data)) + data


def mcap(path: Path, compression: str, chunk: bytes, size: int, count: int = 1) -> Path:
    """Chunks of one time, by https://mcap.dev/spec."""
    definition = typestore().generate_msgdef(IMAGE, ros_version=2)[0]
    known = record(3, struct.pack("<H", 1) + text(IMAGE) + text("ros2msg") + text(definition))
    known += record(4, struct.pack("<HH", 1, 1) + text(TOPIC) + text("cdr") + text(b""))
    data = b"\x89MCAP0\r\n" + record(1, text("ros2") + text("")) + known
    index = b""
    for _ in range(count):
        body = struct.pack("<QQQI", 1, 2, size, 0) + text(compression)
        made = record(6, body + struct.pack("<Q", len(chunk)) + chunk)
        entries = record(7, struct.pack("<HIQQ", 1, 16, 1, 0))
        start, data = len(data), data + made + entries
        body = struct.pack("<QQQQIHQQ", 1, 2, start, len(made), 10, 1, start + len(made), 31)
        index += record(8, body + text(compression) + struct.pack("<QQ", len(chunk), size))
    counts = struct.pack("<QHIIIIQQIHQ", count, 1, 1, 0, 0, count, 1, 2, 10, 1, count)
    end = record(15, bytes(4))
    data += end
    footer = record(2, struct.pack("<QQI", len(data), 0, 0)) + b"\x89MCAP0\r\n"
    (path / "a.mcap").write_bytes(data + known + index + record(11, counts) + footer)
    return path / "a.mcap"


def chunk_of_zstd(path: Path) -> Path:
    return mcap(path, "zstd", packed(), UNPACKED)


def chunk_that_lies(path: Path) -> Path:
    return mcap(path, "zstd", packed(), 1000)


def chunk_of_lz4(path: Path) -> Path:
    return mcap(path, "lz4", lz4.frame.compress(bytes(UNPACKED // 4)), 1000)


def chunks_at_once(path: Path) -> Path:
    return mcap(path, "zstd", packed(BLOCK), BLOCK, 100)


def of_ros1(path: Path, kind: str) -> Path:
    writer = Ros1Writer(path / "a.bag")
    writer.set_compression(writer.CompressionFormat[kind])
    store = get_typestore(Stores.ROS1_NOETIC)
    with writer:
        writer.write(writer.add_connection(TOPIC, IMAGE, typestore=store), 1, bytes(UNPACKED // 4))
    return path / "a.bag"


def bz2_of_ros1(path: Path) -> Path:
    return of_ros1(path, "BZ2")


def lz4_of_ros1(path: Path) -> Path:
    return of_ros1(path, "LZ4")


@pytest.mark.parametrize(
    ("make", "fault"),
    [
        (messages, "packed bytes become more than"),
        (messages_of_mcap, "packed bytes become more than"),
        (lone, "packed bytes become more than"),
        (files, "packed bytes become more than"),
        (lone_file, "packed bytes become more than"),
        (chunk_of_zstd, "chunks of one time are 537 MB"),
        (chunk_that_lies, "packed bytes become more than"),
        (chunk_of_lz4, "packed bytes become more than"),
        (chunks_at_once, "chunks of one time are 1678 MB"),
        (bz2_of_ros1, "packed bytes become more than"),
        (lz4_of_ros1, "packed bytes become more than"),
        (computed, "computes its tables"),
        (endless, "computes its tables"),
    ],
)
def test_recordings(tmp_path, make: Callable[[Path], Path], fault):
    assert fault in said(READ, make(tmp_path))


@pytest.mark.parametrize("yaml", [
    "k0: &a0 {x: 1}\n" + "".join(f"k{n}: &a{n} {{<<: [*a{n-1}, *a{n-1}]}}\n" for n in range(1, 40)),
    "a0: &a0 [x, x]\n" + "".join(f"a{n}: &a{n} [*a{n-1}, *a{n-1}]\n" for n in range(1, 40)),
])  # fmt: skip
def test_profiles_of_a_topic_that_never_end(tmp_path, yaml):
    (file,) = bag(tmp_path / "bag", b"any").glob("*.db3")
    with sqlite3.connect(file) as tables:
        tables.execute("UPDATE topics SET offered_qos_profiles = ?", (yaml,))
    tables.close()
    with open_bag(file) as opened:
        assert list(opened.topics) == [TOPIC]


@pytest.mark.parametrize("unpack", ["unpack_zstd", "_unpack_bz2", "_unpack_lz4"])
def test_what_is_packed_as_recordings_are_comes_out(unpack):
    """A rendered image that is packed 40 times, and a small one that is all alike."""
    data = np.tile(np.random.default_rng(1).integers(0, 256, 500_000, np.uint8), 2).tobytes()
    reader = vars(rosbags.rosbag2.reader)
    pack: Any = {
        "unpack_zstd": (reader.get("zstd") or reader["zstandard"]).compress,
        "_unpack_bz2": bz2.compress,
        "_unpack_lz4": lz4.frame.compress,
    }[unpack]
    for content in (data, bytes(15_000_000), b""):
        assert getattr(containers, unpack)(pack(content)) == content


# -- text --------------------------------------------------------------------------------------


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


def test_packed_lines_that_are_many(tmp_path):
    lines = "".join(f"{k} 0 0 0 0 0 0 1\n" for k in range(100_000))
    (tmp_path / "a.gz").write_bytes(gzip.compress(lines.encode()))
    text = said(COMMAND, "evaluate", tmp_path / "a.gz", tmp_path / "a.gz")
    assert "100000 of 100000 poses" in text
    (tmp_path / "b.gz").write_bytes(gzip.compress(b"#\n" * 30_000_000))
    text = said(COMMAND, "evaluate", tmp_path / "b.gz", tmp_path / "b.gz")
    assert "b.gz unpacks to more text than any trajectory does" in text


# -- images, and numbers that none has -----------------------------------------------------------


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
def test_images_that_are_all_alike(image):
    with pytest.raises(MessageError, match=r"says that it is (12000|8000|6000) x .*, too much for"):
        decode_image(image, "")


@pytest.mark.parametrize("image", [png(2_000, 1), png(1_900, 64), progressive(1_900)])
def test_small_images_may_be_all_alike(image):
    assert not decode_image(image, "").any()


@pytest.mark.parametrize("size", [(2**31, 480), (640, 2**31), (70_000, 480)])
def test_images_of_no_camera(size):
    K = [[500.0, 0.0, 0.5 * size[0]], [0.0, 500.0, 0.5 * size[1]], [0.0, 0.0, 1.0]]
    with pytest.raises(ValueError, match="at most 65536 pixels wide and high, got"):
        Camera(*size, K)


@pytest.mark.parametrize("value", [-1e-6, -np.inf, np.inf])
def test_covariances_of_no_map(tmp_path, value):
    covariances = np.tile(np.eye(3), (2, 1, 1))
    covariances[1, 2, 2] = value
    np.savez(tmp_path / "map.npz", points=np.ones((2, 3)), ids=[1, 2], covariances=covariances)
    with pytest.raises(MapError, match=r"finite variances of 0 or more .* at index 1"):
        read_map_file(tmp_path / "map.npz", "map")


def test_covariances_that_nobody_knows():
    unknown = np.full((2, 3, 3), np.nan)
    assert len(make_map(np.ones((2, 3)), np.array([1, 2]), None, "map", unknown).points) == 2
