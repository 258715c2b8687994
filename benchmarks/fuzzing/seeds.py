# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Right input of every kind, small, to be damaged."""

from __future__ import annotations

import io
import struct
import tempfile
import zlib
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, make_message
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.imu import make_reading
from rs_localizer.io.maps.files import write_npz
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.recording import make_camera_info
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import SimulatedFrame, simulate_frames
from rs_localizer.tools.simulation.simulated_keypoints import keypoint_rows, random_descriptors
from rs_localizer.tools.simulation.simulated_settings import FrameSettings
from rs_localizer.tools.simulation.true_motion import ConstantVelocity

_ROS = b"""
image_width: 640
image_height: 480
distortion_model: plumb_bob
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 319.5, 0, 500, 239.5, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}
"""
_OPENCV = b"""%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 319.5, 0., 500., 239.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 4
   dt: d
   data: [ 0.1, 0., 0., 0. ]
"""
_KALIBR = b"""cam0:
  camera_model: pinhole
  intrinsics: [500.0, 500.0, 319.5, 239.5]
  distortion_model: equidistant
  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]
  resolution: [640, 480]
"""
_COLMAP = b"# cameras\n1 OPENCV 640 480 500 500 320 240 0.1 0 0 0\n"
_JSON = (
    b'{"width": 640, "height": 480, "K": [[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]], "D": [0.1, '
    b'0, 0, 0], "distortion_model": "fisheye"}'
)

_GYROFLOW = b"""{"calib_dimension": {"w": 640, "h": 480}, "fisheye_params": {"camera_matrix":
[[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]], "distortion_coeffs": [0.1, 0, 0, 0]},
"distortion_model": "opencv_fisheye", "frame_readout_time": 9.6}"""
CALIBRATIONS = (_ROS, _OPENCV, _KALIBR, _COLMAP, _JSON, _GYROFLOW)
"""Of every program whose files are read."""

_COUNT = 5
_STAMP = 5_000_000_007  # ns
_K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])


def _header(frame: str) -> SimpleNamespace:
    return SimpleNamespace(stamp=SimpleNamespace(sec=5, nanosec=7), frame_id=frame)


def cloud(*kinds: tuple[Any, ...], big_endian: bool = False, height: int = 1) -> SimpleNamespace:
    """A PointCloud2 with fields of these NumPy types."""
    rng = np.random.default_rng(0)
    rows = np.zeros(_COUNT * height, list(kinds))
    fields = []
    for name, (kind, offset, *_) in (rows.dtype.fields or {}).items():
        rows[name] = rng.integers(0, 200, rows[name].shape)
        if name == "id":
            rows[name] = np.arange(len(rows))
        datatype = "i1 u1 i2 u2 i4 u4 f4 f8".split().index(kind.base.str[1:]) + 1
        count = kind.shape[0] if kind.shape else 1
        fields.append(SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count))
    return SimpleNamespace(
        header=_header("map"),
        height=height,
        width=_COUNT,
        fields=fields,
        is_bigendian=big_endian,
        point_step=rows.dtype.itemsize,
        row_step=rows.dtype.itemsize * _COUNT,
        data=rows.tobytes(),
        is_dense=True,
    )


XYZ = tuple((name, "<f4") for name in "xyz")
UV = (("u", "<f4"), ("v", "<f8"))
BITS, NUMBERS = ("descriptor", "u1", (32,)), ("descriptor", "<f4", (8,))


def plain(message: Any) -> Any:
    """A message of values that can be damaged."""
    if isinstance(message, np.ndarray):
        return message.tobytes() if message.dtype == np.uint8 else message.tolist()
    if isinstance(message, list):
        return [plain(item) for item in message]
    if not is_dataclass(message):
        return message
    return SimpleNamespace(**{f.name: plain(getattr(message, f.name)) for f in fields(message)})


def camera_info(*, whole: bool = False) -> SimpleNamespace:
    """A calibrated camera; a whole one has neither distortion nor binning nor region."""
    lens = np.zeros(0) if whole else np.array([0.1, -0.05, 0.001, 0.0, 0.0])
    made: SimpleNamespace = plain(make_camera_info(Camera(640, 480, _K, lens), _STAMP))
    if not whole:
        made.binning_x, made.binning_y = 1, 2
        made.roi = SimpleNamespace(x_offset=8, y_offset=4, width=320, height=240, do_rectify=False)
    return made


def _reading() -> Any:
    rate, force = np.array([0.1, -0.2, 0.3]), np.array([0.2, -9.7, 0.4])
    return make_reading(_STAMP, rate, force, "imu", (1e-4, 1e-2))


def imu() -> SimpleNamespace:
    """A reading of gyroscope and accelerometer."""
    made: SimpleNamespace = plain(_reading())
    return made


@cache
def _flight() -> tuple[Map, list[SimulatedFrame]]:
    """A small world and some frames of a fast camera."""
    camera = Camera(640, 480, _K, readout_time=0.03)
    motion = ConstantVelocity(np.array([0.5, -1.0, 1.0]), np.array([0.5, 0.2, 0.3]), 0.2)
    points = room(np.zeros((1, 3)), np.random.default_rng(0), count=1500)
    rng = np.random.default_rng(1)
    world = Map(points, np.arange(len(points)), random_descriptors(len(points), rng), "map")
    seen = FrameSettings(points=30, noise=0.5, outliers=0.1)
    return world, list(simulate_frames(camera, motion, points, seen))[1:4]  # 0 is no stamp


def _message(frame: SimulatedFrame, rows: NDArray[Any]) -> SimpleNamespace:
    made: SimpleNamespace = plain(make_cloud(make_message, frame.stamp_ns, "map", rows))
    return made


@cache
def frames() -> tuple[list[SimpleNamespace], list[SimpleNamespace]]:
    """Clouds of correspondences and of keypoints of the same frames."""
    world, flight = _flight()
    correspondences, keypoints = [], []
    for frame in flight:
        rows = np.zeros(len(frame.ids), [*((n, "<f8") for n in "xyz"), ("u", "<f4"), ("v", "<f4")])
        for name, column in zip("xyzuv", [*frame.points.T, *frame.pixels.T], strict=True):
            rows[name] = column
        correspondences.append(_message(frame, rows))
        rng = np.random.default_rng(frame.stamp_ns)
        keypoints.append(_message(frame, keypoint_rows(frame, world, rng)))
    return correspondences, keypoints


def landmarks() -> SimpleNamespace:
    """The map of those keypoints."""
    world, flight = _flight()
    return _message(flight[0], map_rows(world))


def image(encoding: str = "mono8") -> SimpleNamespace:
    """A small picture."""
    depth = {"mono8": 1, "bgr8": 3, "mono16": 2, "yuv422_yuy2": 2}[encoding]
    return SimpleNamespace(
        header=_header("camera"),
        height=6,
        width=8,
        encoding=encoding,
        is_bigendian=False,
        step=8 * depth,
        data=bytes(6 * 8 * depth),
    )


def compressed(suffix: str) -> bytes:
    """The same packed."""
    picture: NDArray[np.uint8] = np.arange(48, dtype=np.uint8).reshape(6, 8)
    return bytes(cv2.imencode(suffix, picture)[1].tobytes())


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def animated_png() -> bytes:
    """Two pictures, one after the other."""
    png = compressed(".png")
    head, pixels = png[:33], zlib.compress((b"\0" + bytes(8)) * 6)
    control = [struct.pack(">5I2H2B", number, 8, 6, 0, 0, 1, 10, 0, 0) for number in (0, 1)]
    first = _chunk(b"acTL", struct.pack(">II", 2, 0)) + _chunk(b"fcTL", control[0])
    second = _chunk(b"fcTL", control[1]) + _chunk(b"fdAT", struct.pack(">I", 2) + pixels)
    return head + first + _chunk(b"IDAT", pixels) + second + png[-12:]


def with_check_sums(png: bytes) -> bytes:
    """A damaged PNG whose chunks are whole again, as far as they can be told."""
    parts, position = [png[:8]], 8
    while position + 12 <= len(png):
        length = min(int.from_bytes(png[position : position + 4]), len(png) - position - 12)
        body = png[position + 8 : position + 8 + length]
        parts.append(_chunk(png[position + 4 : position + 8], body))
        position += 12 + length
    return b"".join(parts)


def _maps() -> list[Map]:
    rng = np.random.default_rng(0)
    points, ids = rng.normal(size=(_COUNT, 3)), np.arange(_COUNT) * 3 - 5
    return [
        Map(points, ids, None, "map"),
        Map(points, None, rng.integers(0, 256, (_COUNT, 4), dtype=np.uint8), "map"),
        Map(points, ids, rng.normal(size=(_COUNT, 3)).astype(np.float32), "map"),
    ]


def map_files() -> list[bytes]:
    """Maps as files."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map"
        for landmarks in _maps():
            write_npz(path, landmarks)
            found.append(path.read_bytes())
    return found


def arrays() -> list[bytes]:
    """What an archive holds, each by itself."""
    found = []
    for array in (np.zeros((_COUNT, 3)), np.arange(_COUNT), np.zeros((_COUNT, 4), np.uint8)):
        stream = io.BytesIO()
        np.save(stream, array)
        found.append(stream.getvalue())
    return found


def recordings() -> dict[str, list[bytes]]:
    """Files of recordings by their suffixes: two readings of an IMU each."""
    found: dict[str, list[bytes]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for storage, suffix in (("mcap", ".mcap"), ("sqlite3", ".db3")):
            path = Path(folder) / storage
            with BagWriter(path, storage) as bag:
                for stamp_ns in (5_000_000_007, 6_000_000_007):
                    bag.write("/imu", _reading(), stamp_ns)
            found[suffix] = [next(path.glob(f"*{suffix}")).read_bytes()]
            found.setdefault("metadata.yaml", [(path / "metadata.yaml").read_bytes()])
        path = Path(folder) / "a.bag"
        store = get_typestore(Stores.ROS1_NOETIC)
        with Ros1Writer(path) as writer:
            connection = writer.add_connection("/t", "std_msgs/msg/Float64", typestore=store)
            message = store.types["std_msgs/msg/Float64"](1.5)
            writer.write(connection, 5, store.serialize_ros1(message, "std_msgs/msg/Float64"))
        found[".bag"] = [path.read_bytes()]
    return found


def map_rows(landmarks: Map) -> NDArray[Any]:
    """Rows (n,) of a cloud of landmarks."""
    kinds: list[tuple[Any, ...]] = [(name, "<f8") for name in "xyz"]
    if landmarks.ids is not None:
        kinds.append(("id", landmarks.id_type))
    if landmarks.descriptors is not None:
        kinds.append(("descriptor", landmarks.descriptors.dtype, landmarks.descriptors.shape[1:]))
    rows = np.empty(len(landmarks), kinds)
    for name, column in zip("xyz", landmarks.points.T, strict=True):
        rows[name] = column
    if landmarks.ids is not None:
        rows["id"] = landmarks.ids
    if landmarks.descriptors is not None:
        rows["descriptor"] = landmarks.descriptors
    return rows
