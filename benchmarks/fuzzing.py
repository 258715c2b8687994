# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Wrong input for everything that reads messages, files and settings.

    python -m benchmarks.fuzzing --executions 1000000

Each target damages right input, reads it, and may raise its own errors only; the tests run it for a
moment. The exit code is 1 when something fails.
"""

import contextlib
import copy
import gzip
import io
import os
import resource
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
import zlib
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from itertools import count, islice
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any, TextIO

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore
from tqdm import tqdm

from benchmarks import command
from rs_localizer import data
from rs_localizer.config import NodeConfig
from rs_localizer.io.bags import BagError, BagWriter, make_message, open_bag
from rs_localizer.io.camera_files import CalibrationError, read_calibration
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import make_cloud, read_correspondences, read_keypoints, read_map
from rs_localizer.io.images import read_image
from rs_localizer.io.imu import make_reading, read_imu
from rs_localizer.io.maps.files import read_map_file
from rs_localizer.io.maps.landmarks import Map, MapError
from rs_localizer.io.messages import MessageError
from rs_localizer.io.trajectories import TrajectoryError, read_tum, read_twists
from rs_localizer.io.video import Video, VideoError
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.markers.maps import MarkerMapError
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.settings import build, load_params_file, parse_assignment

# One input that takes longer (s) hangs, in our eyes.
_TOO_LONG = 5.0
# Bytes that one may take; what asks for more gets a MemoryError, which no reader may raise.
_MOST_MEMORY = 2**30

# -- damages ---------------------------------------------------------------------------------------

# Numbers at which sizes, signs and types change.
_NUMBERS = (0, 1, 2, 3, 7, 8, 9, 16, 127, 128, 255, 256, 1000, 2**15, 2**16 - 1, 2**16, 10**6,
            2**31 - 1, 2**31, 2**32 - 1)  # fmt: skip
_LARGE = (2**32, 2**53, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
_INFINITE = float("inf")
_REALS = (0.0, -0.0, 1.0, -1.0, 0.5, 1e-320, 1e-9, 1e9, 1e38, 3.5e38, 1e154, 1e300, _INFINITE,
          -_INFINITE, float("nan"))  # fmt: skip
_WORDS = (
    b"nan", b"-inf", b"1e999", b"-1", b"1000000000000", b"9" * 40, b"0x10", b"1_0", b"", b" ",
    b"\n", b"\x00", b"\xff\xfe", b"true", b"null", b"[]", b"{}", b"[[[[", b"&a", b"*a", b"!!python",
    b"<<:", b"- ", b": ", b"'", b'"', b"#", b"...", b"---", b"\t",
)  # fmt: skip
_TEXTS = ("", " ", "x", "/", "map", "camera\n", "a" * 300, "\x00", "\ud7ff\U0001f600", "..")
_CODES = ("<B", "<H", ">H", "<I", ">I", "<Q", ">Q", "<f", ">f", "<d", ">d")
_MOST_DAMAGES = 4


def damaged(good: bytes, others: Sequence[bytes], random: Random) -> bytes:
    """Bytes with one to four damages; ``others`` lend parts of theirs."""
    found = bytearray(good)
    for _ in range(random.randint(1, _MOST_DAMAGES)):
        _damage(found, others, random)
    return bytes(found)


def _damage(found: bytearray, others: Sequence[bytes], random: Random) -> None:
    start = random.randrange(len(found) + 1)
    match random.randrange(8):
        case 0 if found:
            found[random.randrange(len(found))] ^= 1 << random.randrange(8)
        case 1:
            _set_number(found, random)
        case 2:
            del found[start:]
        case 3:
            del found[start : start + random.randint(1, 16)]
        case 4:
            part = found[start : start + random.randint(1, 64)]
            found[start:start] = part * random.choice((1, 2, 50))
        case 5:
            other = random.choice(others)
            at = random.randrange(len(other) + 1)
            found[start : start + random.randint(0, 32)] = other[at : at + random.randint(1, 64)]
        case _:  # a word in the place of one
            end = start
            while end < len(found) and found[end] not in b" \n:,[]{}()\t" and end - start < 40:
                end += 1
            found[start:end] = random.choice(_WORDS)


def _set_number(found: bytearray, random: Random) -> None:
    code = random.choice(_CODES)
    size, value = struct.calcsize(code), random.choice(_REALS)
    if code[1] not in "fd":
        value = random.choice(_NUMBERS + _LARGE) % 2 ** (8 * size)
    elif code[1] == "f" and 3.4e38 < abs(value) < _INFINITE:
        value = 0.0
    if len(found) >= size:
        struct.pack_into(code, found, random.randrange(len(found) - size + 1), value)


def damaged_message(message: Any, random: Random) -> Any:
    """A message with one to four fields changed to what its type can hold."""
    found = copy.deepcopy(message)
    for _ in range(random.randint(1, _MOST_DAMAGES)):
        _damage_field(found, random)
    return found


def _damage_field(message: Any, random: Random) -> None:
    name = random.choice(list(vars(message)))
    match getattr(message, name):
        case SimpleNamespace() as value:
            _damage_field(value, random)
        case list() as value:
            _damage_list(value, random)
        case bool() as value:
            setattr(message, name, not value)
        case int() as value:
            choice = random.choice((random.choice(_NUMBERS), value + random.choice((-1, 1))))
            low, high = (-(2**31), 2**31 - 1) if name == "sec" else (0, 2**32 - 1)
            setattr(message, name, min(max(choice, low), high))
        case float():
            setattr(message, name, random.choice(_REALS))
        case str() as value:
            setattr(message, name, random.choice((*_TEXTS, value[:-1], value + "x")))
        case bytes() as value:
            setattr(message, name, damaged(value, (value,), random))


def _damage_list(items: list[Any], random: Random) -> None:
    """Fields of a cloud, numbers of a calibration."""
    if not items:
        return
    place = random.randrange(len(items))
    match random.randrange(5):
        case 0:
            del items[place]
        case 1:
            items.insert(place, copy.deepcopy(random.choice(items)))
        case _ if isinstance(items[place], SimpleNamespace):
            _damage_field(items[place], random)
        case _:
            items[place] = random.choice(_REALS)


# -- right input -----------------------------------------------------------------------------------

_ROS_LENS = b"""image_width: 640
image_height: 480
distortion_model: plumb_bob
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 319.5, 0, 500, 239.5, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}
"""
_CALIBRATIONS = (  # of every program whose files are read
    _ROS_LENS,
    b"%YAML:1.0\n---\n" + _ROS_LENS.replace(b"{rows", b"!!opencv-matrix {dt: d, rows"),
    b"""cam0:
  camera_model: pinhole
  intrinsics: [500.0, 500.0, 319.5, 239.5]
  distortion_model: equidistant
  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]
  resolution: [640, 480]
""",
    b"# cameras\n1 OPENCV 640 480 500 500 320 240 0.1 0 0 0\n",
    b"""{"width": 640, "height": 480, "K": [[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]],
"D": [0.1, 0, 0, 0], "distortion_model": "fisheye"}""",
    b"""{"calib_dimension": {"w": 640, "h": 480}, "fisheye_params": {"camera_matrix":
[[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]], "distortion_coeffs": [0.1, 0, 0, 0]},
"distortion_model": "opencv_fisheye", "frame_readout_time": 9.6}""",
)
_PARAMS = (
    b"""/**/rs_localizer:
  ros__parameters:
    solver: r6p
    velocity_prior: {angular: 0.1}
""",
    b"/**: {ros__parameters: &a {tracking: false, seed: 7}}\nrs_localizer: {ros__parameters: *a}\n",
)
_ASSIGNMENTS = (b"readout_time:=0.03", b"solver:=p3p", b"tracking:=false", b"map_file:=''")
_TUM = (b"# t x y z qx qy qz qw\n1.5 0 0 1 0 0 0 1\n2.5 1 0 1 0 0 0.6 0.8\n",)
_TWISTS = (b"# t wx wy wz vx vy vz\n1.5 0 0 1 0 0 0\n2.5 1 0 1 0 0 0.6\n",)
_MARKERS = (
    b"""# markers of a room, surveyed with a tape measure; lengths in metres, poses of each
map_frame: map
markers:
  - {family: 4x4_50, id: 3, size: 0.16, position: [0, 0, 1.5], quaternion: &q [0.5, 0.5, 0.5, 0.5]}
  - {family: apriltag_36h11, id: 0, corners: [[0, 1, 2], [0, 1.2, 2], [0, 1.2, 1.8], [0, 1, 1.8]]}
boards:
  - {type: chessboard, columns: 6, rows: 4, square: 0.03, position: [0, 0, 0], quaternion: *q}
""",
    b"target_type: aprilgrid\ntagCols: 4\ntagRows: 3\ntagSize: 0.05\ntagSpacing: 0.3\n",
)


def plain(message: Any) -> Any:
    """A message of values that can be damaged."""
    if isinstance(message, np.ndarray):
        return message.tobytes() if message.dtype == np.uint8 else message.tolist()
    if isinstance(message, list):
        return [plain(item) for item in message]
    if not is_dataclass(message):
        return message
    return SimpleNamespace(**{f.name: plain(getattr(message, f.name)) for f in fields(message)})


def map_rows(landmarks: Map) -> NDArray[Any]:
    """Rows (n,) of a cloud of landmarks."""
    kinds: list[tuple[Any, ...]] = [(name, "<f8") for name in "xyz"]
    columns = list(landmarks.points.T)
    if landmarks.ids is not None:
        kinds.append(("id", landmarks.id_type))
        columns.append(landmarks.ids)
    if landmarks.descriptors is not None:
        kinds.append(("descriptor", landmarks.descriptors.dtype, landmarks.descriptors.shape[1:]))
        columns.append(landmarks.descriptors)
    rows = np.empty(len(landmarks), kinds)
    for (name, *_), column in zip(kinds, columns, strict=True):
        rows[name] = column
    return rows


def _cloud(*kinds: tuple[Any, ...], big_endian: bool = False, height: int = 1) -> Any:
    """A PointCloud2 of five points a row with fields of these NumPy types."""
    rows = np.zeros(5 * height, list(kinds))
    for name in rows.dtype.names or ():
        drawn = np.random.default_rng(0).integers(0, 200, rows[name].shape)
        rows[name] = np.arange(len(rows)) if name == "id" else drawn
    made = plain(make_cloud(make_message, _STAMP, "map", rows))
    made.width, made.height = made.width // height, height
    made.row_step, made.is_bigendian = made.row_step // height, big_endian
    return made


_STAMP = 5_000_000_007  # ns
_XYZ = tuple((name, "<f4") for name in "xyz")
_UV = (("u", "<f4"), ("v", "<f8"))
_BITS, _FLOATS = ("descriptor", "u1", (32,)), ("descriptor", "<f4", (8,))


@cache
def _frames() -> tuple[Any, list[Any], list[Any], Any]:
    """Of the bundled webcam: camera_info, clouds, the same as keypoints, and their map."""
    with open_bag(data.path(data.WEBCAM)) as bag:
        messages = list(islice(bag.messages(list(bag.topics)), 6))
    info = next(message for topic, _, message in messages if topic == "/camera_info")
    clouds = [message for topic, _, message in messages if topic == "/correspondences"]
    marks = np.random.default_rng(0).integers(0, 256, (24, 32), np.uint8)
    first, keypoints = read_correspondences(clouds[0]), []
    landmarks = Map(first.points, None, marks[first.table["id"]], "map")
    for cloud in map(read_correspondences, clouds):
        rows = np.zeros(len(cloud.points), [*_UV, _BITS])
        rows["u"], rows["v"] = cloud.pixels.T
        rows["descriptor"] = marks[cloud.table["id"]]
        keypoints.append(plain(make_cloud(make_message, cloud.stamp_ns, "map", rows)))
    of_map = plain(make_cloud(make_message, _STAMP, "map", map_rows(landmarks)))
    return plain(info), plain(clouds), keypoints, of_map


def _reading() -> Any:
    rate, force = np.array([0.1, -0.2, 0.3]), np.array([0.2, -9.7, 0.4])
    return make_reading(_STAMP, rate, force, "imu", (1e-4, 1e-2))


def _image(encoding: str, depth: int) -> Any:
    header = plain(_reading().header)
    return SimpleNamespace(
        header=header, height=6, width=8, encoding=encoding, is_bigendian=False, step=8 * depth,
        data=bytes(6 * 8 * depth),
    )  # fmt: skip


def _compressed(suffix: str) -> bytes:
    picture: NDArray[np.uint8] = np.arange(48, dtype=np.uint8).reshape(6, 8)
    return bytes(cv2.imencode(suffix, picture)[1].tobytes())


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _with_check_sums(png: bytes) -> bytes:
    """A damaged PNG whose chunks are whole again, as far as they can be told."""
    parts, position = [png[:8]], 8
    while position + 12 <= len(png):
        length = min(int.from_bytes(png[position : position + 4]), len(png) - position - 12)
        body = png[position + 8 : position + 8 + length]
        parts.append(_chunk(png[position + 4 : position + 8], body))
        position += 12 + length
    return b"".join(parts)


def _recordings(folder: Path) -> dict[str, bytes]:
    """Files of recordings by their suffixes: two readings of an IMU each."""
    found = {}
    for storage, suffix in ((StoragePlugin.MCAP, ".mcap"), (StoragePlugin.SQLITE3, ".db3")):
        with BagWriter(folder / storage.name.lower(), storage) as bag:
            for stamp_ns in (_STAMP, _STAMP + 10**9):
                bag.write("/imu", _reading(), stamp_ns)
        found[suffix] = next((folder / storage.name.lower()).glob(f"*{suffix}")).read_bytes()
    found["metadata.yaml"] = (folder / "mcap" / "metadata.yaml").read_bytes()
    store = get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(folder / "right.bag") as writer:
        connection = writer.add_connection("/t", "std_msgs/msg/Float64", typestore=store)
        message = store.types["std_msgs/msg/Float64"](1.5)
        writer.write(connection, 5, store.serialize_ros1(message, "std_msgs/msg/Float64"))
    return found | {".bag": (folder / "right.bag").read_bytes()}


# -- targets ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Target:
    """A reader: makes wrong input for itself, reads it, and may raise these errors only."""

    make: Callable[[Random], Any]
    read: Callable[[Any], object]
    errors: tuple[type[Exception], ...]
    every: int = 1  # of how many turns it takes one


def targets(folder: Path) -> dict[str, Target]:
    """All of them; files are written into the folder."""
    info, clouds, shown, landmarks = _frames()
    readers: dict[str, tuple[tuple[Any, ...], Callable[[Any], object]]] = {
        "correspondences": (
            (_cloud(*_XYZ, *_UV, ("score", "<f8"), ("id", "<u2")),
             _cloud(*_UV, ("other", "<f4"), *_XYZ, height=2)),
            read_correspondences,
        ),
        "keypoints": (
            (_cloud(*_UV, _BITS, ("score", "<f4")),
             _cloud(*_UV, ("id", "<i2"), _FLOATS, height=2)),
            read_keypoints,
        ),
        "map_points": (
            (_cloud(*_XYZ, ("id", "<u4"), _BITS), _cloud(*_XYZ, _FLOATS, big_endian=True)),
            read_map,
        ),
        "camera_info": (
            (info,), lambda message: read_camera_info(message).camera(0.03, "top_to_bottom")
        ),
        "imu": ((plain(_reading()),), read_imu),
        "image": (
            (_image("mono8", 1), _image("bgr8", 3), _image("mono16", 2), _image("yuv422_yuy2", 2)),
            read_image,
        ),
    }  # fmt: skip
    bags, broken = _recordings(folder), folder / "broken"
    broken.mkdir()
    (broken / "mcap.mcap").write_bytes(bags[".mcap"])

    def of_files(
        name: str, good: Sequence[bytes], read: Callable[[Path], object], error: type[Exception],
        every: int = 1,
    ) -> Target:  # fmt: skip
        return Target(_bytes(good), _file(folder / name, read), (error,), every)

    def of_map(path: Path) -> object:
        return read_map_file(path, "map")

    # NumPy's, where warnings are errors: points at 1e300 are finite, their squares are not.
    overflows = (RuntimeWarning,)
    return {
        "localize": Target(_messages(clouds), _Localizer(None), overflows, every=10),
        "localize_keypoints": Target(_messages(shown), _Localizer(landmarks), overflows, every=10),
        **{
            name: Target(_messages(good), read, (MessageError,))
            for name, (good, read) in readers.items()
        },
        "image/compressed": Target(_pictures, _read_picture, (MessageError,)),
        "map .npz": Target(_archives, _file(folder / "a.npz", of_map), (MapError,)),
        "params file": of_files(
            "params.yaml", _PARAMS, lambda path: build(load_params_file(path)), ValueError
        ),
        "name:=value": Target(_bytes(_ASSIGNMENTS), _assign, (ValueError,)),
        "trajectory": of_files("poses.txt", _TUM, read_tum, TrajectoryError),
        "trajectory .gz": Target(
            _packed, _file(folder / "poses.txt.gz", read_tum), (TrajectoryError,)
        ),
        "twists": of_files("twists.txt", _TWISTS, read_twists, TrajectoryError),
        "calibration": of_files("camera.yaml", _CALIBRATIONS, read_calibration, CalibrationError),
        "marker map": of_files("markers.yaml", _MARKERS, read_marker_map, MarkerMapError),
        "video .mjpeg": of_files(
            "v.mjpeg", [2 * _compressed(".jpg")], lambda path: sum(1 for _ in Video(path)),
            VideoError,
        ),
        **{
            f"bag {suffix}": of_files(f"a{suffix}", [bags[suffix]], _read_bag, BagError, 4)
            for suffix in (".mcap", ".db3", ".bag")
        },
        "metadata.yaml": of_files(
            "broken/metadata.yaml", [bags["metadata.yaml"]], lambda path: _read_bag(path.parent),
            BagError, 4,
        ),
    }  # fmt: skip


class _Localizer:
    """Answers any message, and raises nothing."""

    def __init__(self, landmarks: Any) -> None:
        self._info, clouds, shown, _ = _frames()
        self._landmarks, self._good = landmarks, (clouds if landmarks is None else shown)[0]

    def __call__(self, message: Any) -> object:
        # A new one each time, so that a number says all of an execution.
        node = CameraFrames(NodeConfig(readout_time=0.03))
        node.calibrate(read_camera_info(self._info))
        if self._landmarks is None:
            node.localize(self._good)  # so that the other one is tracked
            return node.localize(message)
        node.landmarks.use_map(read_map(self._landmarks))
        node.localize_keypoints(self._good)
        return node.localize_keypoints(message)


def _messages(templates: Sequence[Any]) -> Callable[[Random], Any]:
    return lambda random: damaged_message(random.choice(templates), random)


def _bytes(good: Sequence[bytes]) -> Callable[[Random], bytes]:
    return lambda random: damaged(random.choice(good), good, random)


def _file(path: Path, read: Callable[[Path], object]) -> Callable[[bytes], object]:
    return lambda content: (path.write_bytes(content), read(path))


def _packed(random: Random) -> bytes:
    """Damaged text, packed with a right check sum, and packed text that is damaged."""
    if random.random() < 0.6:
        return gzip.compress(damaged(_TUM[0], _TUM, random), mtime=0)
    return damaged(gzip.compress(_TUM[0], mtime=0), _TUM, random)


@cache
def _shown() -> list[bytes]:
    return [_compressed(".png"), _compressed(".jpg"), _compressed(".tiff")]


def _pictures(random: Random) -> bytes:
    picture = damaged(random.choice(_shown()), _shown(), random)
    repaired = picture.startswith(b"\x89PNG") and random.random() < 0.7
    return _with_check_sums(picture) if repaired else picture


def _read_picture(packed: bytes) -> object:
    header = plain(_reading().header)
    return read_image(SimpleNamespace(header=header, format="jpeg", data=packed))


@cache
def _arrays() -> list[bytes]:
    """What an archive holds, each by itself."""
    found = []
    for array in (np.zeros((5, 3)), np.arange(5), np.zeros((5, 4), np.uint8)):
        stream = io.BytesIO()
        np.save(stream, array)
        found.append(stream.getvalue())
    return found


def _archives(random: Random) -> bytes:
    """An archive of damaged arrays, whose check sums are right, or a damaged archive."""
    stream, whole = io.BytesIO(), random.random() < 0.7
    method = random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(stream, "w", method) as file:
        for name, array in zip(("points", "ids", "descriptors"), _arrays(), strict=True):
            if name == "points" or random.random() < 0.5:
                spoilt = whole and random.random() < 0.7
                part = damaged(array, _arrays(), random) if spoilt else array
                file.writestr(f"{name}.npy", part)
    return stream.getvalue() if whole else damaged(stream.getvalue(), _arrays(), random)


def _read_bag(path: Path) -> object:
    with open_bag(path) as bag:
        return sum(1 for _ in bag.messages(list(bag.topics)))


def _assign(text: bytes) -> object:
    try:
        name, value = parse_assignment(text.decode())
    except UnicodeDecodeError:  # a command line is text
        return None
    return build({name: value})


# -- a run over all of them ------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Failure:
    """An input that raised what it must not, or took too long."""

    target: str
    number: int  # of the execution: the same seed and number give the same input
    what: str
    case: Any


@dataclass(slots=True)
class Report:
    """What happened."""

    outcomes: dict[str, Counter[str]] = field(default_factory=dict)  # of each target
    failures: list[Failure] = field(default_factory=list)

    @property
    def executions(self) -> int:
        return sum(sum(counts.values()) for counts in self.outcomes.values())

    def text(self) -> str:
        """A table for people."""
        lines = []
        for target, counts in self.outcomes.items():
            listed = ", ".join(f"{name} {number}" for name, number in counts.most_common())
            lines.append(f"{target:18} {sum(counts.values()):9d}  {listed}")
        lines.append(f"{self.executions} executions, {len(self.failures)} failures")
        for failure in self.failures[:20]:
            lines.append(f"\n{failure.target}, number {failure.number}: {failure.what:.300}")
            lines.append(f"  {failure.case!r:.2000}")
        return "\n".join(lines)


def run(chosen: Mapping[str, Target], executions: int, seed: int) -> Iterator[Report]:
    """Feed all targets in turn; the report so far, after every execution."""
    report = Report({name: Counter() for name in chosen})
    turns = (name for turn in count() for name, it in chosen.items() if turn % it.every == 0)
    for number, name in enumerate(islice(turns, executions)):
        _execute(report, name, chosen[name], seed, number)
        yield report


def _execute(report: Report, name: str, target: Target, seed: int, number: int) -> None:
    case = target.make(Random(f"{seed} {name} {number}"))
    start = time.process_time()  # on a busy machine the clock says nothing
    try:
        target.read(case)
        outcome = "read"
    except target.errors as error:
        outcome = type(error).__name__
    except Exception as error:
        outcome = f"FAILED: {type(error).__name__}"
        where = traceback.extract_tb(error.__traceback__)[-1]
        what = f"{error!r} in {where.name}, {where.filename}:{where.lineno}"
        report.failures.append(Failure(name, number, what, case))
    seconds = time.process_time() - start
    if seconds > _TOO_LONG:
        report.failures.append(Failure(name, number, f"took {seconds:.1f} s", case))
    report.outcomes[name][outcome] += 1


@contextlib.contextmanager
def _silent_libraries() -> Iterator[TextIO]:
    """Discard what libpng and libjpeg say of every picture; the terminal, for others."""
    with os.fdopen(os.dup(2), "w") as stderr, Path(os.devnull).open("w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
        try:
            yield stderr
        finally:
            os.dup2(stderr.fileno(), 2)


def main() -> int:
    parser = command(".fuzzing", __doc__)
    parser.add_argument("--executions", type=int, default=1_000_000, metavar="N")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    warnings.simplefilter("error")
    # In memory where there is such a place: a million small files are no work for a disk.
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        chosen = targets(Path(folder))
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + _MOST_MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        reports = run(chosen, options.executions, options.seed)
        with _silent_libraries() as stderr:
            bar = tqdm(reports, total=options.executions, unit="input", file=stderr, disable=None)
            (report,) = deque(bar, maxlen=1)
    sys.stdout.write(f"{report.text()}\n")
    return 1 if report.failures else 0


if __name__ == "__main__":
    sys.exit(main())
