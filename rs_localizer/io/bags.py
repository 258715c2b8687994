# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings: rosbag2 (MCAP, sqlite3) and ROS 1 bags in, rosbag2 out, by the rosbags library.

Messages come out as rosbags' plain objects with the attribute names of ROS 2, whatever the
recording was; the readers of this package take them and rclpy's messages alike.
"""

import contextlib
import re
import shutil
import sqlite3
from collections.abc import Collection, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

from rosbags import interfaces as qos
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.errors import WriterError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

from rs_localizer.io import detections
from rs_localizer.io.topics import TF_STATIC

_METADATA, _SUFFIXES = "metadata.yaml", (".mcap", ".db3", ".bag")
# Players advertise topics with the QoS recorded in the bag; subscribers to /tf_static expect
# transient-local durability.
_NO_LIMIT = qos.QosTime(2**31 - 1, 10**9 - 1)
_LATCHED = qos.Qos(
    qos.QosHistory.KEEP_LAST, 1, qos.QosReliability.RELIABLE, qos.QosDurability.TRANSIENT_LOCAL,
    _NO_LIMIT, _NO_LIMIT, qos.QosLiveliness.AUTOMATIC, _NO_LIMIT, False,
)  # fmt: skip


class BagError(ValueError):
    """A recording that cannot be read or written; the message names the path and the fault."""


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Return the message types of ROS 2 Jazzy, and of detections, which ROS does not have."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in detections.DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def make_message(type_name: str, **fields: Any) -> Any:
    """Make a message for :class:`BagWriter` of a type such as ``geometry_msgs/msg/Pose``.

    Every field has to be given; number arrays as NumPy arrays of the field's type.
    """
    return typestore().types[type_name](**fields)


class BagReader:
    """An open recording (see :func:`open_bag`)."""

    def __init__(self, path: Path, reader: AnyReader) -> None:
        self.path, self._reader = path, reader
        kinds: dict[str, set[str]] = {}
        for connection in reader.connections:
            kinds.setdefault(connection.topic, set()).add(normalize_msgtype(connection.msgtype))
        self.topics: dict[str, str] = {
            name: next(iter(types)) if len(types) == 1 else "several types"
            for name, types in sorted(kinds.items())
        }

    def count(self, topics: Collection[str]) -> int:
        """Return the number of messages that the recording holds on these topics."""
        counts = self._reader.topics
        return sum(counts[topic].msgcount for topic in topics if topic in counts)

    def find_topic(
        self, types: Collection[str], given: str | None, option: str, name: str = ""
    ) -> str:
        """Return a topic of one of these types: the given one, or the only one.

        Args:
            option: that gives one, as ``-r NAME:=TOPIC``.
            name: topics that end in it are preferred.

        Raises:
            BagError: when it is not there, or several could be meant.
        """
        of_type = sorted(topic for topic, kind in self.topics.items() if kind in types)
        wanted, there = " or ".join(types), ", ".join(of_type) or "none"
        if given is not None:
            if given in of_type:
                return given
            fault = f"is of type {self.topics[given]}" if given in self.topics else "does not exist"
            raise BagError(f"{self.path}: {given} {fault}; topics of type {wanted}: {there}")
        named = [topic for topic in of_type if name and topic.split("/")[-1] == name]
        for candidates in (named, of_type):
            if len(candidates) == 1:
                return candidates[0]
            if candidates:
                raise BagError(
                    f"{self.path} has several topics of type {wanted}: {', '.join(candidates)}; "
                    f"choose one with {option}"
                )
        known = ", ".join(f"{topic} ({kind})" for topic, kind in self.topics.items())
        raise BagError(
            f"{self.path} has no topic of type {wanted} for {option}; it has {known or 'none'}"
        )

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time of recording (ns) and message, in the order of that time.

        Raises:
            BagError: for a topic that is not in the recording, or damaged data.
        """
        if missing := [topic for topic in topics if topic not in self.topics]:
            raise BagError(
                f"{self.path} has no topic {', '.join(missing)}; it has "
                f"{', '.join(sorted(self.topics))}"
            )
        wanted = [c for c in self._reader.connections if c.topic in topics]
        if not wanted:
            return
        with _explained(self.path):
            if self._reader.is2:
                self._check_types({c.msgtype for c in wanted})
            for connection, stamp_ns, data in self._reader.messages(connections=wanted):
                kind = normalize_msgtype(connection.msgtype)
                message = self._reader.deserialize(data, kind)
                if kind == "sensor_msgs/msg/CameraInfo" and not self._reader.is2:
                    message = _as_ros2(message, kind)
                yield connection.topic, stamp_ns, message

    def _check_types(self, names: Collection[str]) -> None:
        """Refuse types that a recording describes otherwise than ROS: fields would be missed."""
        own, standard = self._reader.typestore.fielddefs, typestore().fielddefs
        for name in (set(names) & set(standard)) - set(detections.DEFINITIONS):
            if _fields_of(name, own) != _fields_of(name, standard):
                raise BagError(f"{self.path} describes {name} otherwise than ROS 2 Jazzy does")


@contextlib.contextmanager
def open_bag(path: Path | str) -> Iterator[BagReader]:
    """Open a rosbag2 directory, a file of one, or a ROS 1 bag.

    Raises:
        BagError: when there is no such recording, or it is damaged or empty.
    """
    path = Path(path)
    with contextlib.ExitStack() as stack:
        with _explained(path):
            reader = stack.enter_context(AnyReader(_files(path), default_typestore=typestore()))
            bag = BagReader(path, reader)
            if bag.count(bag.topics) == 0:
                raise BagError(f"{path} is an empty recording: it holds no message")
        yield bag


def _fields_of(name: str, defined: Mapping[str, Any]) -> Any:
    """Return the fields of a message type, with type names replaced by their fields."""

    def expanded(item: Any) -> Any:
        if isinstance(item, (tuple, list)):
            return [expanded(part) for part in item]
        return expanded(defined[item][1]) if item in defined else item

    return expanded(defined[name][1])


def is_bag(path: Path) -> bool:
    """Return True for a recording; False for a video or a folder of images."""
    if path.is_dir():
        return (path / _METADATA).exists() or bool(_data_files(path))
    return path.suffix in _SUFFIXES


def _data_files(folder: Path) -> list[Path]:
    """Return the recorded files of a folder, in the order of the numbers in their names."""
    files = [file for file in folder.iterdir() if file.suffix in _SUFFIXES]
    numbers = {file: [int(n) for n in re.findall(r"\d+", file.name)] for file in files}
    return sorted(files, key=lambda file: (numbers[file], file.name))


def _files(path: Path) -> list[Path]:
    """Return what rosbags opens: files, or a folder with its metadata.

    A recorder that was killed leaves its data without metadata, or with an empty file.
    """
    if not path.exists():
        raise BagError(f"{path} does not exist")
    if not is_bag(path):
        raise BagError(
            f"{path} is not a recording: expected a rosbag2 folder, or a file that ends in "
            f"{', '.join(_SUFFIXES)}"
        )
    about = path / _METADATA
    if path.is_dir() and not (about.is_file() and about.stat().st_size):
        return _data_files(path)
    return [path]


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn whatever goes wrong while a recording is read into a BagError."""
    try:
        yield
    except (BagError, GeneratorExit):
        raise
    except Exception as error:
        # A damaged file shows as errors of struct, sqlite, YAML, zstd, assertions and more.
        reason = " ".join(str(error).split()) or type(error).__name__
        if "end magic" in reason:
            reason = f"it is cut off: mcap recover {path.name} -o MENDED (https://mcap.dev)"
        raise BagError(f"{path} cannot be read as a recording: {reason}") from error


def _as_ros2(message: Any, type_name: str) -> Any:
    """Convert a camera_info of ROS 1, where D, K, R and P are in upper case."""
    fields = {name.lower(): getattr(message, name) for name in message.__dataclass_fields__}
    fields.pop("__msgtype__", None)
    return make_message(type_name, **fields)


class BagWriter:
    """Writes a rosbag2 directory; a context manager.

    Messages that were written before an exception (also Ctrl-C) stay readable. Without any message,
    nothing is left (see :mod:`rs_localizer.io.atomic_files` for all or nothing).

    Args:
        path: the directory to create.
        storage: kind of its files.

    Raises:
        BagError: when the path exists, cannot be created, or its disk takes no more.
    """

    def __init__(self, path: Path | str, storage: StoragePlugin = StoragePlugin.MCAP) -> None:
        self._path = Path(path)
        self._connections: dict[str, Any] = {}
        try:
            self._writer = Writer(self._path, version=9, storage_plugin=storage)
        except WriterError:
            raise BagError(f"{self._path} exists already; it is not overwritten") from None

    make = staticmethod(make_message)

    def __enter__(self) -> Self:
        try:
            self._writer.open()
        except (WriterError, OSError) as error:
            raise BagError(f"{self._path} cannot be written: {error}") from error
        return self

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        """Append a message of :func:`make_message`; ``stamp_ns`` is its time of recording."""
        kind = message.__msgtype__
        data = typestore().serialize_cdr(message, kind)
        with self._explained():
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(
                    topic, kind, typestore=typestore(),
                    offered_qos_profiles=[_LATCHED] if topic == TF_STATIC else [],
                )  # fmt: skip
            self._writer.write(self._connections[topic], stamp_ns, data)

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except (OSError, sqlite3.Error) as error:
            text = error.strerror if isinstance(error, OSError) else None
            raise BagError(f"{self._path} cannot be written: {text or error}") from error

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is None:
            with self._explained():
                self._writer.close()
            return
        with contextlib.suppress(OSError, sqlite3.Error):  # a full disk takes no end either
            self._writer.close()
        if not self._connections:
            shutil.rmtree(self._path)  # nothing was written: leave nothing in the way
