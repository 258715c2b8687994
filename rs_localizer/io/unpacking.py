# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Decompressors with a limit: few bytes of a recording stand for no gigabytes.

rosbags has none (131 kB of a recording took 2.3 GB). Its tables of decompressors, by name of the
compression, are given these; the packages that it needs have no common interface.
"""

import bz2
import importlib
import importlib.util
import io
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import rosbags.rosbag1.reader
import rosbags.rosbag2.reader
import rosbags.rosbag2.storage_mcap
import rosbags.rosbag2.storage_sqlite3

# Rendered images without noise, the best packed of all that anybody records, come to 40 times, and
# a single small message may be all alike. What is large is measured, and comes to 4 times.
_BEST, _ALIKE = 50, 2**24
_MEASURED, _LARGE = 8, 2**27
# Of whole files, which go to the disk.
_FILE_ALIKE = 2**28
_STEP = 2**20
_WITH_QOS = (
    rosbags.rosbag2.reader, rosbags.rosbag2.storage_mcap, rosbags.rosbag2.storage_sqlite3,
)  # fmt: skip


class UnpackingError(ValueError):
    """A packed message is damaged, or larger than anybody records."""


def most_unpacked(packed: int) -> int:
    """Bytes that so many packed bytes of a message or a text may become."""
    return min(_BEST * packed + _ALIKE, max(_LARGE, _MEASURED * packed))


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
    """The module that rosbags unpacks with: of Python from 3.14 on, else of a package."""
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
    most = left = _BEST * size + _FILE_ALIKE
    with packed.open("rb") as data, _zstd().open(data, "rb") as file, out.open("wb") as target:
        while part := file.read(_STEP):
            left -= len(part)
            if left < 0:
                raise _too_large(size, most)
            target.write(part)


def limit_rosbags() -> None:
    """Have rosbags read chunks by these decompressors, and no QoS of recordings."""
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
