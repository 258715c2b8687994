# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Files that are whole or not there, and files whose size or claims have no end."""

import errno
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

from rs_localizer.io.atomic_files import (
    OutputError,
    atomic_directory,
    atomic_files,
    content,
)
from rs_localizer.io.bags import BagError, open_bag
from rs_localizer.io.images import decode_image
from rs_localizer.io.maps.files import read_map_file
from rs_localizer.io.maps.landmarks import MapError, make_map
from rs_localizer.io.messages import MessageError
from rs_localizer.io.video import Video, VideoError


def test_what_was_finished_stays(tmp_path):
    with atomic_directory(tmp_path / "out") as out:
        out.mkdir()
        (out / "a").write_text("a")
    assert (tmp_path / "out" / "a").read_text() == "a"
    with pytest.raises(OutputError, match="out exists already; it is not overwritten"):
        atomic_directory(tmp_path / "out").__enter__()
    assert (tmp_path / "out" / "a").read_text() == "a"


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("no"), SystemExit(1)])
def test_what_was_not_finished_is_gone(tmp_path, error):
    making = atomic_directory(tmp_path / "out")
    out = making.__enter__()
    out.mkdir()
    (out / "a").write_text("a")
    assert not making.__exit__(type(error), error, None)  # the error goes on
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_named_and_nothing_half_written(tmp_path):
    """A limit for the size of files fails at the same place as a full disk."""
    code = (
        "import resource; from pathlib import Path\n"
        "from rs_localizer.io.atomic_files import atomic_directory\n"
        "from rs_localizer.io.bags import BagError, BagWriter, make_message\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "try:\n"
        "    with atomic_directory(Path('bag')) as out, BagWriter(out) as bag:\n"
        "        message = make_message('std_msgs/msg/String', data='a' * 10_000)\n"
        "        for k in range(1000): bag.write('/a', message, k)\n"
        "except BagError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout == "bag cannot be written: File too large\n"
    assert list(tmp_path.iterdir()) == []


def test_files_are_whole_or_not_there(tmp_path):
    first, second = tmp_path / "a", tmp_path / "b"

    making, error = atomic_files(first, second), OSError(28, "No space left on device")
    part, _ = making.__enter__()
    part.write_text("a")
    assert not first.exists()
    with pytest.raises(OutputError, match="a cannot be written: No space left on device"):
        making.__exit__(OSError, error, None)
    assert list(tmp_path.iterdir()) == []
    with atomic_files(first, second) as (part, _):
        part.write_text("a")
    assert list(tmp_path.iterdir()) == [first]
    with atomic_files(Path("/dev/null")) as (part,):
        part.write_text("a")
    assert Path("/dev/null").is_char_device()


def test_an_empty_directory_is_filled_and_an_earlier_result_replaced(tmp_path):
    out = tmp_path / "out"
    out.mkdir()  # a mount point, say: it stays the same
    number = out.stat().st_ino
    (out / "lost+found").mkdir()  # of a disk
    for text, earlier in (("a", ()), ("b", ("a", "b"))):
        with atomic_directory(out, earlier) as built:
            built.mkdir()
            (built / text).write_text(text)
            assert content(out) == list(earlier[:1])
        assert content(out) == [text]
        assert (out / text).read_text() == text
    assert out.stat().st_ino == number
    assert (out / "lost+found").is_dir()


OLD = {"same": "old", "gone": "old", "folder/same": "old", "folder/gone": "old"}
NEW = {"same": "new", "more": "new", "folder/same": "new", "folder/more": "new"}


def make(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def tree(folder: Path) -> dict[str, str]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_text() for path in files}


def write_directory(place: Path) -> None:
    out = place / "out"
    with atomic_directory(out, content(out)) as built:
        make(built, NEW)


def test_all_is_on_the_disk_before_what_was_goes(tmp_path, monkeypatch):
    """As far as a test can tell without cutting the power."""
    make(tmp_path / "out", OLD)
    synced, gone, rename, fsync = set(), [], os.rename, os.fsync

    def sync(descriptor: int) -> None:
        synced.add(os.stat(descriptor).st_ino)
        fsync(descriptor)

    def move(source: Path, target: Path) -> None:
        if Path(source).parent == tmp_path / "out":
            gone.append(Path(source).name)
            made = [path for path in (Path(target).parents[1] / "out").rglob("*") if path.is_file()]
            assert len(made) == len(NEW)
            assert all(path.stat().st_ino in synced for path in made)
        rename(source, target)

    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(os, "rename", move)
    write_directory(tmp_path)
    assert sorted(gone) == ["folder", "gone", "same"]
    assert tree(tmp_path / "out") == NEW


def test_what_cannot_be_replaced_stays_and_does_not_block(tmp_path, monkeypatch):
    """As a name within the result that is a mount point."""
    make(tmp_path / "out", OLD)
    rename = os.rename

    def move(source: Path, target: Path) -> None:
        if source == tmp_path / "out" / "same":
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY), str(source))
        rename(source, target)

    with monkeypatch.context() as patched:
        patched.setattr(os, "rename", move)
        with pytest.raises(OutputError, match="busy"):
            write_directory(tmp_path)
    assert tree(tmp_path / "out") == OLD
    write_directory(tmp_path)
    assert tree(tmp_path / "out") == NEW


@pytest.mark.parametrize("old", [{}, OLD])
def test_who_was_killed_blocks_nothing(tmp_path, old):
    make(tmp_path / "out", old)
    code = (
        "import os; from pathlib import Path\n"
        "from rs_localizer.io.atomic_files import atomic_directory, content\n"
        "with atomic_directory(Path('out'), content(Path('out'))) as built:\n"
        "    built.mkdir(); (built / 'same').write_text('half'); os._exit(9)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False).returncode == 9
    place = tmp_path / "out"
    left = list(tmp_path.rglob(".unfinished-*"))
    assert len(left) == 1
    assert content(place) == sorted({name.split("/")[0] for name in old})
    write_directory(tmp_path)
    assert content(place) == ["folder", "more", "same"]
    assert {name: (place / name).read_text() for name in NEW} == NEW


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
