# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Files of recordings, known by what they hold and not by their names, as rosbags can open them.

rosbags goes by suffixes, by ``metadata.yaml``, by a whole end of an MCAP, and by its profile. Here
a file that is packed is unpacked, one that is named otherwise gets a name, and an MCAP that was cut
off, or that has another profile, is shown to rosbags with a head and an end of ours.
"""

import contextlib
import io
import re
import sqlite3
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

METADATA = "metadata.yaml"
ZSTD = b"\x28\xb5\x2f\xfd"
_MCAP, _SQLITE, _BAG = b"\x89MCAP0\r\n", b"SQLite format 3\0", b"#ROSBAG V2.0"
_SUFFIX = {_MCAP: ".mcap", _SQLITE: ".db3", _BAG: ".bag"}
# In a folder these are not looked into: there may be a hundred thousand.
_OTHERS = (".jpg", ".jpeg", ".png", ".yaml", ".txt", ".csv", ".json", ".mp4")
# Records of an MCAP: https://mcap.dev/spec
_HEADER, _FOOTER, _CHUNK, _MESSAGES, _CHUNK_INDEX, _STATISTICS, _DATA_END = 1, 2, 6, 7, 8, 11, 15
_LEAST_CHUNK = 40


class Storage(NamedTuple):
    """What rosbags opens."""

    paths: list[Any]  # files, or a folder with its metadata
    fault: str | None = None  # what is to be said of them


def magic(path: Path) -> bytes:
    """First bytes of a file, of those that may be recordings; empty: it is none."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        start = file.read(16)
        kind = next((known for known in (*_SUFFIX, ZSTD) if start.startswith(known)), b"")
        return kind if kind != _SQLITE or _has_messages(path) else b""
    return b""


def _has_messages(path: Path) -> bool:
    """True for a database that is a recording, and not one of COLMAP, say; a damaged one may be."""
    try:
        with contextlib.closing(
            sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
        ) as db:
            query = "SELECT count(*) FROM sqlite_master WHERE name IN ('messages', 'topics')"
            return bool(db.execute(query).fetchone()[0] == 2)
    except (sqlite3.Error, UnicodeDecodeError):  # its words may be none
        return path.suffix == ".db3"


def data_files(folder: Path) -> list[Path]:
    """The files of a folder that are recordings, in the order of the numbers in their names."""
    files = [
        file for file in folder.iterdir() if file.suffix.lower() not in _OTHERS and magic(file)
    ]
    numbers = {file: [int(n) for n in re.findall(r"\d+", file.name)] for file in files}
    return sorted(files, key=lambda file: (numbers[file], file.name))


@contextlib.contextmanager
def storage(
    path: Path, files: list[Path] | None, unpack: Callable[[Path, Path], object]
) -> Iterator[Storage]:
    """Within ``with``, what rosbags opens of a recording.

    Args:
        path: of a file, or of a folder.
        files: of the folder, as its metadata lists them; None: it has none that can be used.
        unpack: writes what a .zst file holds to another one.

    Raises:
        ValueError: for what is no recording.
    """
    if not path.is_dir():
        found = [path]
    elif files and all(file.is_file() and _is_whole(file) for file in files):
        yield Storage([path])
        return
    else:
        found = data_files(path)
    if not found:
        raise ValueError("the folder has neither metadata.yaml nor a file with messages")
    opened: list[Any] = []
    faults: list[str] = []
    with TemporaryDirectory(prefix="rs_localizer-") as folder:
        for number, file in enumerate(found):
            kind, data = magic(file), file
            if kind == ZSTD:
                data = Path(folder) / f"{number}"
                unpack(file, data)
                kind = magic(data)
            if kind not in _SUFFIX:
                raise ValueError(f"{file.name} is neither an MCAP, a database of rosbag2 nor a bag")
            if kind == _MCAP and not _is_whole(data):
                shown = _Mended.of(data)
                opened.append(shown)
                faults += [shown.fault] if shown.fault else []
            elif data.suffix == _SUFFIX[kind]:
                opened.append(data)
            else:
                link = Path(folder) / f"link{number}{_SUFFIX[kind]}"
                link.symlink_to(data.resolve())
                opened.append(link)
        yield Storage(opened, "; ".join(faults) or None)


def _is_whole(path: Path) -> bool:
    """True for a file that is no MCAP, or one with an end and the profile of ROS 2."""
    if magic(path) != _MCAP:
        return True
    with path.open("rb") as file:
        start = file.read(64)
        file.seek(max(0, path.stat().st_size - len(_MCAP)))
        return file.read() == _MCAP and _profile(start) == b"ros2"


def _profile(start: bytes) -> bytes:
    length = int.from_bytes(start[17:21], "little")
    return start[21 : 21 + length]


def _record(kind: int, data: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(data)) + data


def _string(text: bytes) -> bytes:
    return struct.pack("<I", len(text)) + text


@dataclass(frozen=True)
class _Mended:
    """What rosbags takes of a path: an MCAP with a head of ROS 2, its whole records, and an index.

    In its messages nothing is changed.
    """

    path: Path
    parts: tuple[bytes | tuple[int, int], ...]  # bytes, or begin and end in the file
    fault: str | None
    suffix = ".mcap"

    @staticmethod
    def of(path: Path) -> "_Mended":
        size = path.stat().st_size
        head = _MCAP + _record(_HEADER, _string(b"ros2") + _string(b""))
        chunks: list[tuple[bytes, int, int, set[int]]] = []
        channels: set[int] = set()
        kind = 0
        with path.open("rb") as file:
            start = file.read(64)
            begin = at = 17 + int.from_bytes(start[9:17], "little")
            while at + 9 <= size and kind not in (_DATA_END, _FOOTER):
                file.seek(at)
                kind, length = struct.unpack("<BQ", file.read(9))
                if at + 9 + length > size or kind in (_DATA_END, _FOOTER):
                    break
                if kind == _CHUNK and length >= _LEAST_CHUNK:
                    place = len(head) + at - begin
                    chunks.append((file.read(min(length, 100)), place, 9 + length, set()))
                elif kind == _MESSAGES and chunks:  # of a channel in the chunk before
                    channel = int.from_bytes(file.read(2), "little")
                    chunks[-1][-1].add(channel)
                    channels.add(channel)
                at += 9 + length
        end = _record(_DATA_END, bytes(4))
        summary = len(head) + at - begin + len(end)
        # Numbers of zero: rosbags counts what it finds.
        index = b"".join(_index(*chunk[:3], chunk[3] or channels) for chunk in chunks)
        index += _record(_STATISTICS, bytes(46)) if chunks else b""
        footer = _record(_FOOTER, struct.pack("<QQI", summary if index else 0, 0, 0)) + _MCAP
        fault = None
        if kind not in (_DATA_END, _FOOTER):
            share = 100.0 * at / max(size, 1)
            fault = f"{path.name} is cut off: the {share:.0f} % of it that are whole are read"
        return _Mended(path, (head, (begin, at), end + index + footer), fault)

    def exists(self) -> bool:
        return True

    def is_dir(self) -> bool:
        return False

    def open(self, mode: str) -> io.BufferedReader:
        assert mode == "rb"
        return io.BufferedReader(_Spliced(self.path.open("rb"), self.parts), 2**16)

    def __str__(self) -> str:
        return str(self.path)


def _index(chunk: bytes, at: int, length: int, channels: set[int]) -> bytes:
    """The index of a chunk, by how it begins; where in it messages are, rosbags does not ask."""
    first, last, unpacked, _, name = struct.unpack_from("<QQQII", chunk)
    compression = chunk[32 : 32 + name]
    (packed,) = struct.unpack_from("<Q", chunk, 32 + name)
    offsets = b"".join(struct.pack("<HQ", channel, 0) for channel in sorted(channels))
    places = struct.pack("<QQQQ", first, last, at, length) + _string(offsets) + bytes(8)
    return _record(
        _CHUNK_INDEX, places + _string(compression) + struct.pack("<QQ", packed, unpacked)
    )


class _Spliced(io.RawIOBase):
    """Bytes and parts of a file, one after the other."""

    def __init__(self, file: Any, parts: tuple[bytes | tuple[int, int], ...]) -> None:
        self._file, self._parts = file, parts
        self._sizes = [len(p) if isinstance(p, bytes) else p[1] - p[0] for p in parts]
        self._at = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: sum(self._sizes)}[whence]
        self._at = max(0, base + offset)
        return self._at

    def readinto(self, buffer: Any) -> int:
        begin = self._at
        for part, size in zip(self._parts, self._sizes, strict=True):
            if begin < size:
                count = min(len(buffer), size - begin)
                if isinstance(part, bytes):
                    data = part[begin : begin + count]
                else:
                    self._file.seek(part[0] + begin)
                    data = self._file.read(count)
                buffer[: len(data)] = data
                self._at += len(data)
                return len(data)
            begin -= size
        return 0

    def close(self) -> None:
        self._file.close()
        super().close()
