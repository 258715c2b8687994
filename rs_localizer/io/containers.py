# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Files of recordings, recognized by their content and not by their names, for rosbags.

rosbags goes by suffixes and by ``metadata.yaml``. Here a file that is packed is unpacked, and one
that is named otherwise gets a name. Few bytes of a recording stand for no gigabytes: rosbags'
tables of decompressors, by name of the compression, are given ours, which have a limit (131 kB of a
recording took 2.3 GB); the packages that it needs have no common interface.
"""

import bz2
import contextlib
import importlib
import importlib.util
import io
import re
import sqlite3
import struct
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any, BinaryIO

import rosbags.rosbag1.reader
import rosbags.rosbag2.reader
import rosbags.rosbag2.storage_mcap
import rosbags.rosbag2.storage_sqlite3

from rs_localizer.io.reading import BEST_PACKED, most_unpacked

METADATA = "metadata.yaml"
ZSTD = b"\x28\xb5\x2f\xfd"
_MCAP, _SQLITE, _BAG = b"\x89MCAP0\r\n", b"SQLite format 3\0", b"#ROSBAG V2.0"
_SUFFIX = {_MCAP: ".mcap", _SQLITE: ".db3", _BAG: ".bag"}
# Files in a folder that are not opened: there may be a hundred thousand.
_OTHERS = (".jpg", ".jpeg", ".png", ".yaml", ".txt", ".csv", ".json", ".mp4")


def read_magic(path: Path) -> bytes:
    """Return the first bytes of a file that may be a recording; empty if it cannot be one."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        start = file.read(16)
        kind = next((known for known in (*_SUFFIX, ZSTD) if start.startswith(known)), b"")
        return kind if kind != _SQLITE or _has_messages(path) else b""
    return b""


def _has_messages(path: Path) -> bool:
    """Return True for a database that may be a recording (a damaged one, too), not COLMAP's."""
    try:
        with contextlib.closing(
            sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
        ) as db:
            query = "SELECT count(*) FROM sqlite_master WHERE name IN ('messages', 'topics')"
            return bool(db.execute(query).fetchone()[0] == 2)
    except (sqlite3.Error, UnicodeDecodeError):  # its words may be none
        return path.suffix == ".db3"


def data_files(folder: Path) -> list[Path]:
    """Return files of a folder that are recordings, in the order of the numbers in their names."""
    files = [
        file for file in folder.iterdir() if file.suffix.lower() not in _OTHERS and read_magic(file)
    ]
    numbers = {file: [int(n) for n in re.findall(r"\d+", file.name)] for file in files}
    return sorted(files, key=lambda file: (numbers[file], file.name))


@contextlib.contextmanager
def storage(
    path: Path, files: list[Path] | None, packed: bool, unpack: Callable[[Path, Path], object]
) -> Iterator[list[Path]]:
    """Yield what rosbags opens of a recording: files, or a folder with its metadata.

    Args:
        path: of a file, or of a folder.
        files: of the folder, as its metadata lists them; None: it has none that can be used.
        packed: whether they, or their messages, are packed; rosbags would unpack without a limit.
        unpack: unpacks a .zst file to another file.

    Raises:
        ValueError: for a file that is no recording, an MCAP that is cut off or not of ROS 2, or a
            file that claims or computes more than it holds.
    """
    listed = files if files and all(file.is_file() for file in files) else None
    if listed and not packed:
        for file in listed:
            _check(file, file.name)
        yield [path]
        return
    found = [path] if not path.is_dir() else listed or data_files(path)
    if not found:
        raise ValueError("the folder has neither metadata.yaml nor a file with messages")
    opened: list[Path] = []
    with TemporaryDirectory(prefix="rs_localizer-") as folder:
        for number, file in enumerate(found):
            kind, data = read_magic(file), file
            if kind == ZSTD:
                data = Path(folder) / f"{number}"
                unpack(file, data)
                kind = read_magic(data)
            if kind not in _SUFFIX:
                raise ValueError(f"{file.name} is neither an MCAP, a database of rosbag2 nor a bag")
            _check(data, file.name)
            if data.suffix != _SUFFIX[kind]:
                link = Path(folder) / f"link{number}{_SUFFIX[kind]}"
                link.symlink_to(data.resolve())
                data = link
            opened.append(data)
        yield opened


def _check(path: Path, name: str) -> None:
    kind = read_magic(path)
    if kind == _MCAP:
        _check_mcap(path, name)
    elif kind == _SQLITE:
        _check_tables(path, name)


def _check_tables(path: Path, name: str) -> None:
    """Refuse a database that computes rows or cells: a few bytes would be endlessly many."""
    with contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as db:
        kinds = db.execute(
            "SELECT count(*) FROM sqlite_master WHERE type NOT IN ('table', 'index') "
            "OR sql LIKE 'CREATE VIRTUAL%'"
        ).fetchone()[0]
        hidden = db.execute(
            "SELECT count(*) FROM sqlite_master AS m, pragma_table_xinfo(m.name) AS c "
            "WHERE m.type = 'table' AND c.hidden"
        ).fetchone()[0]
    if kinds or hidden:
        raise ValueError(f"{name} computes its tables, which no recorder writes")


def _check_mcap(path: Path, name: str) -> None:
    """Refuse an MCAP without an end, or of another profile (https://mcap.dev/spec)."""
    with path.open("rb") as file:
        start = file.read(64)
        end = file.seek(-len(_MCAP), 2)
        if end == 0 or file.read() != _MCAP:  # else it is the start
            raise ValueError(f"{name} is cut off: mcap recover {name} -o MENDED (https://mcap.dev)")
        profile = start[21 : 21 + int.from_bytes(start[17:21], "little")].decode(errors="replace")
        if profile != "ros2":
            raise ValueError(f"{name} has the profile {profile!r}; record or convert it as ROS 2")
        packed, unpacked = _most_at_a_time(_chunks(file))
    if unpacked > most_unpacked(packed):
        raise ValueError(
            f"{name}: chunks of one time are {unpacked / 1e6:.0f} MB, packed {packed / 1e6:.1f} MB"
        )


_CHUNK_INDEX, _FOOTER = 8, 2  # kinds of records
_LONGEST_INDEX = 2**20  # bytes, of one with a hundred thousand topics
_FOOTER_BYTES = 37  # with the end of the file
_RECORD = struct.Struct("<BQ")


def _chunks(file: BinaryIO) -> Iterator[tuple[int, int, int, int]]:
    """Yield first and last time (ns), packed and unpacked bytes of the chunks in the index."""
    file.seek(-_FOOTER_BYTES, 2)
    summary = int.from_bytes(file.read(17)[9:], "little")
    file.seek(summary)
    while summary and len(head := file.read(_RECORD.size)) == _RECORD.size:
        kind, size = _RECORD.unpack(head)
        if kind == _FOOTER:
            return
        if kind != _CHUNK_INDEX or size > _LONGEST_INDEX:
            file.seek(size, 1)
            continue
        data = file.read(size)
        if len(data) != size or size < 64:
            return  # rosbags says what is wrong
        start, end = struct.unpack_from("<QQ", data)
        # Behind it stand the name of the compression and its length.
        packed, unpacked = struct.unpack_from("<QQ", data, size - 16)
        yield start, end, packed, unpacked


def _most_at_a_time(chunks: Iterable[tuple[int, int, int, int]]) -> tuple[int, int]:
    """Return packed and unpacked bytes of the chunks that are open at once, read by time."""
    changes = sorted(
        change
        for start, end, packed, unpacked in chunks
        for change in ((start, 0, packed, unpacked), (end, 1, -packed, -unpacked))
    )
    packed = unpacked = 0
    most = (0, 0)
    for _, _, more_packed, more in changes:
        packed, unpacked = packed + more_packed, unpacked + more
        most = max(most, (packed, unpacked), key=lambda sizes: sizes[1])
    return most


# -- decompressors with a limit -----------------------------------------------------------------

# Limit of a whole unpacked file, which goes to the disk.
_FILE_ALIKE = 2**28
_STEP = 2**20
_WITH_QOS = (
    rosbags.rosbag2.reader, rosbags.rosbag2.storage_mcap, rosbags.rosbag2.storage_sqlite3,
)  # fmt: skip


class UnpackingError(ValueError):
    """A packed message is damaged, or larger than anybody records."""


def _read(file: IO[bytes], packed: int) -> bytes:
    most = most_unpacked(packed)
    if len(data := file.read(most + 1)) > most:
        raise _too_large(packed, most)
    return data


def _too_large(packed: int, most: int) -> UnpackingError:
    return UnpackingError(
        f"{packed} packed bytes become more than {most / 1e6:.0f} MB, which nobody records"
    )


def _zstd() -> Any:
    """Return the module with which rosbags unpacks: Python's own from 3.14 on, else a package."""
    reader = vars(rosbags.rosbag2.reader)
    return reader["zstd"] if "zstd" in reader else reader["zstandard"]


def unpack_zstd(data: bytes) -> bytes:
    """Return the bytes that a message or chunk of Zstandard holds, up to a limit."""
    with _zstd().open(io.BytesIO(data), "rb") as file:
        return _read(file, len(data))


def _unpack_lz4(data: bytes) -> bytes:
    with importlib.import_module("lz4.frame").open(io.BytesIO(data), "rb") as file:
        return _read(file, len(data))


def _unpack_bz2(data: bytes) -> bytes:
    with bz2.open(io.BytesIO(data), "rb") as file:
        return _read(file, len(data))


def unpack_file(packed: Path, out: Path) -> None:
    """Write a file of Zstandard unpacked to ``out``."""
    size = packed.stat().st_size
    most = left = BEST_PACKED * size + _FILE_ALIKE
    with packed.open("rb") as data, _zstd().open(data, "rb") as file, out.open("wb") as target:
        while part := file.read(_STEP):
            left -= len(part)
            if left < 0:
                raise _too_large(size, most)
            target.write(part)


def limit_rosbags() -> None:
    """Make rosbags read chunks by these decompressors, and ignore the QoS of recordings."""
    limited: dict[str, Callable[[bytes], bytes]] = {"zstd": unpack_zstd, "bz2": _unpack_bz2}
    if importlib.util.find_spec("lz4") is not None:  # else it packs 255 times at most by its format
        limited["lz4"] = _unpack_lz4
    chunks: dict[str, Any] = rosbags.rosbag2.storage_mcap.DECOMPRESSORS
    chunks |= {name: _of_size(limited[name]) for name in chunks.keys() & limited.keys()}
    of_ros1: dict[str, Any] = rosbags.rosbag1.reader.decompressors
    of_ros1 |= {name: limited[name] for name in of_ros1.keys() & limited.keys()}
    # Its YAML merges and nests without a limit, too, and nobody here asks for a topic's QoS.
    for module in _WITH_QOS:
        vars(module)["parse_qos"] = lambda _: []


def _of_size(unpack: Callable[[bytes], bytes]) -> Callable[[bytes, int], bytes]:
    def unpacked(data: bytes, size: int) -> bytes:
        if size > (most := most_unpacked(len(data))):
            raise _too_large(len(data), most)
        return unpack(data)

    return unpacked
