# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What is fed with wrong input, and with which errors it may answer."""

from __future__ import annotations

import gzip
import io
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

from benchmarks.fuzzing import seeds
from benchmarks.fuzzing.mutations import damaged, damaged_message
from rs_localizer.config import NodeConfig
from rs_localizer.io.bags import BagError, open_bag
from rs_localizer.io.camera_files import CalibrationError, read_calibration
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import read_correspondences, read_keypoints, read_map
from rs_localizer.io.images import read_compressed_image, read_image
from rs_localizer.io.imu import read_imu
from rs_localizer.io.maps.files import read_map_file
from rs_localizer.io.maps.landmarks import MapError
from rs_localizer.io.messages import MessageError
from rs_localizer.io.trajectories import TrajectoryError, read_tum, read_twists
from rs_localizer.io.video import Video, VideoError
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.markers.maps import MarkerMapError
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.settings import build, load_params_file, parse_assignment

_PARAMS = b"""
/**/rs_localizer:
  ros__parameters:
    readout_time: 0.03
    solver: r6p
    velocity_prior:
      angular: 0.1
    imu: {use: none, wait: 0.1}
"""
_ANCHORED_PARAMS = b"""
/**:
  ros__parameters: &a
    tracking: false
    seed: 7
rs_localizer:
  ros__parameters: *a
"""
_ASSIGNMENTS = (b"readout_time:=0.03", b"solver:=p3p", b"tracking:=false", b"map_file:=''")
_TUM = b"# t x y z qx qy qz qw\n1.5 0 0 1 0 0 0 1\n2.5 1 0 1 0 0 0.6 0.8\n"
_TWISTS = b"# t wx wy wz vx vy vz\n1.5 0 0 1 0 0 0\n2.5 1 0 1 0 0 0.6\n"
_TARGET = b"target_type: aprilgrid\ntagCols: 4\ntagRows: 3\ntagSize: 0.05\ntagSpacing: 0.3\n"
_MARKERS = b"""# markers of a room, surveyed with a tape measure; lengths in metres, poses of each
map_frame: map
markers:
  - family: 4x4_50
    id: 3
    size: 0.16
    position: [0.0, 0.0, 1.5]
    quaternion: &q [0.5, 0.5, 0.5, 0.5]
  - {family: apriltag_36h11, id: 0, corners: [[0, 1, 2], [0, 1.2, 2], [0, 1.2, 1.8], [0, 1, 1.8]]}
boards:
  - {type: chessboard, columns: 6, rows: 4, square: 0.03, position: [0, 0, 0], quaternion: *q}
"""


# NumPy's, where warnings are errors: points at 1e300 are finite, their squares are not.
_OVERFLOWS = (RuntimeWarning,)


@dataclass(frozen=True, slots=True)
class Target:
    """A reader: makes wrong input for itself, reads it, and may raise these errors only."""

    make: Callable[[Random], Any]
    read: Callable[[Any], object]
    errors: tuple[type[Exception], ...]
    every: int = 1  # of how many turns it takes one


def targets(folder: Path) -> dict[str, Target]:
    """All of them; files are written into the folder."""
    clouds = (
        seeds.cloud(*seeds.XYZ, *seeds.UV, ("score", "<f8"), ("id", "<u2")),
        seeds.cloud(*seeds.UV, ("other", "<f4"), *seeds.XYZ, height=2),
    )
    keypoints = (
        seeds.cloud(*seeds.UV, seeds.BITS, ("score", "<f4")),
        seeds.cloud(*seeds.UV, ("id", "<i2"), seeds.NUMBERS, height=2),
    )
    landmarks = (
        seeds.cloud(*seeds.XYZ, ("id", "<u4"), seeds.BITS),
        seeds.cloud(*seeds.XYZ, seeds.NUMBERS, big_endian=True),
    )
    pictures = tuple(map(seeds.image, ("mono8", "bgr8", "mono16", "yuv422_yuy2")))
    message, map_error = (MessageError,), (MapError,)
    frames, shown = seeds.frames()
    return {
        "localize": Target(_messages(frames), _Localizer(None), _OVERFLOWS, every=10),
        "localize_keypoints": Target(
            _messages(shown), _Localizer(seeds.landmarks()), _OVERFLOWS, every=10
        ),
        "correspondences": Target(_messages(clouds), read_correspondences, message),
        "keypoints": Target(_messages(keypoints), read_keypoints, message),
        "map_points": Target(_messages(landmarks), read_map, message),
        "camera_info": Target(_messages((seeds.camera_info(),)), _read_camera, message),
        "imu": Target(_messages((seeds.imu(),)), read_imu, message),
        "image": Target(_messages(pictures), read_image, message),
        "image/compressed": Target(_pictures, _compressed, message),
        "map .npz": Target(_bytes(seeds.map_files()), _file(folder / "a.npz", _map), map_error),
        "map .npz, arrays": Target(_archives, _file(folder / "b.npz", _map), map_error),
        "params file": Target(
            _bytes((_PARAMS, _ANCHORED_PARAMS)),
            _file(folder / "params.yaml", _read_params),
            (ValueError,),
        ),
        "name:=value": Target(_bytes(_ASSIGNMENTS), _assign, (ValueError,)),
        "trajectory": Target(
            _bytes((_TUM,)), _file(folder / "poses.txt", read_tum), (TrajectoryError,)
        ),
        "calibration": Target(
            _bytes(seeds.CALIBRATIONS),
            _file(folder / "camera.yaml", read_calibration),
            (CalibrationError,),
        ),
        "marker map": Target(
            _bytes((_MARKERS, _TARGET)),
            _file(folder / "markers.yaml", read_marker_map),
            (MarkerMapError,),
        ),
    } | _more_files(folder)


def _more_files(folder: Path) -> dict[str, Target]:
    """Recordings and tables."""
    bags = seeds.recordings()
    broken = folder / "broken"
    broken.mkdir()
    (broken / "mcap.mcap").write_bytes(bags[".mcap"][0])
    found = {
        f"bag {suffix}": Target(
            _bytes(bags[suffix]), _file(folder / f"a{suffix}", _read_bag), (BagError,), every=4
        )
        for suffix in (".mcap", ".db3", ".bag")
    }
    return found | {
        "metadata.yaml": Target(
            _bytes(bags["metadata.yaml"]),
            _file(broken / "metadata.yaml", lambda path: _read_bag(path.parent)),
            (BagError,),
            every=4,
        ),
        "trajectory .gz": Target(
            _packed((_TUM,)), _file(folder / "poses.txt.gz", read_tum), (TrajectoryError,)
        ),
        "twists": Target(
            _bytes((_TWISTS,)), _file(folder / "twists.txt", read_twists), (TrajectoryError,)
        ),
        "video .mjpeg": Target(
            _bytes([2 * seeds.compressed(".jpg")]),
            _file(folder / "v.mjpeg", _read_film),
            (VideoError,),
        ),
    }


def _packed(good: Sequence[bytes]) -> Callable[[Random], bytes]:
    """Damaged text, packed with a right check sum, and packed text that is damaged."""

    def make(random: Random) -> bytes:
        if random.random() < 0.6:
            return gzip.compress(damaged(random.choice(good), good, random), mtime=0)
        return damaged(gzip.compress(random.choice(good), mtime=0), good, random)

    return make


def _read_bag(path: Path) -> object:
    with open_bag(path) as bag:
        return sum(1 for _ in bag.messages(list(bag.topics)))


def _read_film(path: Path) -> object:
    return sum(1 for _ in Video(path))


class _Localizer:
    """Answers any message, and raises nothing."""

    def __init__(self, landmarks: Any) -> None:
        self._landmarks = landmarks
        self._good = seeds.frames()[landmarks is not None][0]

    def __call__(self, message: Any) -> object:
        # A new one each time, so that a number says all of an execution.
        node = CameraFrames(NodeConfig(readout_time=0.03))
        node.calibrate(read_camera_info(seeds.camera_info(whole=True)))
        if self._landmarks is None:
            node.localize(self._good)  # so that the other one is tracked
            return node.localize(message)
        node.use_map(read_map(self._landmarks))
        node.localize_keypoints(self._good)
        return node.localize_keypoints(message)


def _messages(templates: Sequence[Any]) -> Callable[[Random], Any]:
    return lambda random: damaged_message(random.choice(templates), random)


def _bytes(good: Sequence[bytes]) -> Callable[[Random], bytes]:
    return lambda random: damaged(random.choice(good), good, random)


_PICTURES = [seeds.compressed(f".{name}") for name in ("png", "jpg", "webp", "tiff")]
_PICTURES.append(seeds.animated_png())


def _pictures(random: Random) -> bytes:
    picture = damaged(random.choice(_PICTURES), _PICTURES, random)
    repaired = picture.startswith(b"\x89PNG") and random.random() < 0.7
    return seeds.with_check_sums(picture) if repaired else picture


_ARRAYS = seeds.arrays()


def _archives(random: Random) -> bytes:
    """An archive in order, with damaged arrays in it: whose check sums are right."""
    stream = io.BytesIO()
    method = random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(stream, "w", method) as file:
        for name, array in zip(("points", "ids", "descriptors"), _ARRAYS, strict=True):
            if name == "points" or random.random() < 0.5:
                data = damaged(array, _ARRAYS, random) if random.random() < 0.7 else array
                file.writestr(f"{name}.npy", data)
    return stream.getvalue()


def _file(path: Path, read: Callable[[Path], object]) -> Callable[[bytes], object]:
    def run(data: bytes) -> object:
        path.write_bytes(data)
        return read(path)

    return run


def _map(path: Path) -> object:
    return read_map_file(path, "map")


def _read_camera(message: Any) -> object:
    return read_camera_info(message).camera(0.03, "top_to_bottom")


def _compressed(data: bytes) -> object:
    header = seeds.camera_info().header
    return read_compressed_image(SimpleNamespace(header=header, format="jpeg", data=data))


def _read_params(path: Path) -> object:
    return build(load_params_file(path))


def _assign(data: bytes) -> object:
    try:
        name, value = parse_assignment(data.decode())
    except UnicodeDecodeError:  # a command line is text
        return None
    return build({name: value})
