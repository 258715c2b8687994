# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images with a gyroscope beside them, as phones, boards and video cameras write them.

* a folder of **Stray Scanner** (a free app for iPhones with LiDAR): ``rgb.mp4``, ``odometry.csv``,
  ``imu.csv``, ``camera_matrix.csv``, ``depth/*.png`` (mm), ``confidence/*.png`` (0 to 2)
* a folder of images with ``frames.csv`` (``timestamp_ns``, ``exposure_us``, ``path``) and
  ``imu.csv`` (``timestamp_ns``, ``gyro_x_rad_s``, ...), as recorders of OAK-D cameras write it
* a video with a gyroscope inside

Axes and clock of the gyroscope are found later, by :func:`benchmarks.real.gyroscopes.aligned`.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.real.clips import video_images
from benchmarks.real.gyroscopes import Gyroscope
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.telemetry import has_telemetry, read_telemetry
from rs_localizer.io.video import Video

Gray = NDArray[np.uint8]
# Stray Scanner's video lacks the first image of its table: the second stamp, pose and depth are
# those of the video's first image.
_STRAY_LATE = 1
_SURE = 2  # of Stray Scanner's confidences 0, 1, 2
_METRES = 1e-3  # of Stray Scanner's depths
# Focal lengths that autofocus moves by more make one camera matrix wrong.
_FOCUS = 0.003


@dataclass(frozen=True, slots=True, eq=False)
class Depths:
    """Depths of images, and where the phone itself believes that they were taken."""

    rotations: Array  # (f,3,3) map_from_camera
    positions: Array  # (f,3) m
    files: Sequence[tuple[Path, Path]]  # of depths and confidences

    def at(self, image: int, pixels: Array, size: tuple[int, int]) -> Array:
        """Metres (n,) along the optical axis at pixels (n,2); NaN where they are not sure."""
        raw, sure = (cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in self.files[image])
        if raw is None or sure is None:
            return np.full(len(pixels), np.nan)
        metres = np.where((sure == _SURE) & (raw > 0), _METRES * raw, np.nan).astype(np.float32)
        share = np.array(metres.shape[::-1]) / np.array(size)
        place = ((pixels + 0.5) * share - 0.5).astype(np.float32)
        # Between four depths: an unsure one among them spoils the mean, as it should.
        depths = cv2.remap(
            metres, place[:, :1], place[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(depths[:, 0], np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Footage:
    """One clip."""

    name: str
    images: Callable[[], Iterator[tuple[int, Gray]]]  # stamps in ns; middles of exposures
    gyroscope: Gyroscope  # by about that clock, in axes of its own
    camera: Camera | None = None  # its lens; None: not known
    depths: Depths | None = None
    readout_time: float = 0.0  # s; 0: not known


def read_footage(path: Path) -> Footage:
    """The clip of a folder or video.

    Raises:
        ValueError: for another, saying what was found.
    """
    if (path / "rgb.mp4").is_file():
        return read_stray(path)
    if (path / "frames.csv").is_file():
        return read_frames(path)
    if path.is_file():
        return read_video(path)
    found = sorted(file.name for file in path.iterdir())[:5] if path.is_dir() else "nothing"
    raise ValueError(
        f"{path} must be a video, a folder with rgb.mp4 (Stray Scanner) or one with frames.csv; "
        f"found {found}"
    )


def read_stray(folder: Path) -> Footage:
    """A folder of Stray Scanner; raises ``ValueError`` for files that lack something."""
    names = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
    table = _columns(folder / "odometry.csv", names)
    rows = {name: column[_STRAY_LATE:] for name, column in table.items()}
    matrix = np.loadtxt(folder / "camera_matrix.csv", delimiter=",")
    if matrix.shape != (3, 3):
        raise ValueError(f"{folder / 'camera_matrix.csv'} must be 3x3, found {matrix.shape}")
    if "fx" in rows:  # written by newer versions of the app, for each image
        spread = np.ptp(rows["fx"]) / np.median(rows["fx"])
        if spread > _FOCUS:
            print(f"{folder}: autofocus has moved the focal length by {spread:.1%}: lock it")
    first = next(iter(Video(folder / "rgb.mp4"))).image
    camera = Camera(first.shape[1], first.shape[0], K=matrix)
    stamps = np.rint(1e9 * rows["timestamp"]).astype(np.int64).tolist()
    numbers = [f"{int(frame):06d}.png" for frame in rows["frame"]]
    turns = Rotation.from_quat(np.column_stack([rows[f"q{axis}"] for axis in "xyzw"]))
    depths = Depths(
        turns.as_matrix(),
        np.column_stack([rows[axis] for axis in "xyz"]),
        [(folder / "depth" / name, folder / "confidence" / name) for name in numbers],
    )

    def images() -> Iterator[tuple[int, Gray]]:
        for stamp, shot in zip(stamps, Video(folder / "rgb.mp4"), strict=False):
            yield stamp, shot.image

    gyroscope = _gyroscope(folder / "imu.csv", "timestamp", [f"alpha_{axis}" for axis in "xyz"])
    return Footage(folder.name, images, gyroscope, camera, depths)


def read_frames(folder: Path) -> Footage:
    """Images with ``frames.csv`` and ``imu.csv``; raises ``ValueError`` where they lack something.

    Stamps are the end of the exposure, as DepthAI gives them.
    """
    path = folder / "frames.csv"
    table = _columns(path, ("timestamp_ns", "exposure_us"), ("path",))
    files = _text(path, "path")
    # The middle of the exposure moves against the stamp where exposure is automatic.
    stamps = np.rint(table["timestamp_ns"] - 500.0 * table["exposure_us"]).astype(np.int64)

    def images() -> Iterator[tuple[int, Gray]]:
        for stamp, name in zip(stamps.tolist(), files, strict=True):
            image = cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)
            if image is not None:
                yield stamp, np.asarray(image, np.uint8)

    names = [f"gyro_{axis}_rad_s" for axis in "xyz"]
    gyroscope = _gyroscope(folder / "imu.csv", "timestamp_ns", names)
    return Footage(folder.name, images, gyroscope)


def read_video(path: Path) -> Footage:
    """A video with a gyroscope inside.

    Raises:
        ValueError: without a gyroscope, or with a stabilizer that has moved the rows.
    """
    telemetry = read_telemetry(path) if has_telemetry(path) else None
    if telemetry is None:
        raise ValueError(f"{path} has no gyroscope inside; give a text of t wx wy wz: --gyroscope")
    if telemetry.stabilizer:
        raise ValueError(f"{path} is stabilized ({telemetry.stabilizer}): film with it off")

    def images() -> Iterator[tuple[int, Gray]]:
        # Who writes a gyroscope into a video writes times.
        return ((round(1e9 * seconds), image) for seconds, image in video_images(path))

    gyroscope = Gyroscope(telemetry.times, telemetry.rates)
    return Footage(path.stem, images, gyroscope, readout_time=telemetry.readout_time or 0.0)


def _gyroscope(path: Path, time: str, names: Sequence[str]) -> Gyroscope:
    table = _columns(path, (time, *names))
    seconds = table[time] * (1e-9 if time.endswith("_ns") else 1.0)
    rates = np.column_stack([table[name] for name in names])
    # Packets without a reading are blank; some recorders write one twice.
    whole = np.isfinite(rates).all(axis=1)
    seconds, order = np.unique(seconds[whole], return_index=True)
    if len(seconds) < 2:
        raise ValueError(f"{path} has {len(seconds)} readings of a gyroscope")
    return Gyroscope(seconds, rates[whole][order])


def _columns(path: Path, names: Sequence[str], texts: Sequence[str] = ()) -> dict[str, Array]:
    """Columns of numbers of a table with a heading; blanks are NaN.

    Raises:
        ValueError: for a file that lacks columns.
    """
    rows = _rows(path)
    has = list(rows[0]) if rows else []
    missing = [name for name in (*names, *texts) if name not in has]
    if missing:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)}; it has {has}")
    return {
        name: np.array([_number(row[name]) for row in rows]) for name in has if name not in texts
    }


def _text(path: Path, name: str) -> list[str]:
    return [row[name] for row in _rows(path)]


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        raise ValueError(f"{path} is missing")
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.reader(file, skipinitialspace=True)
        heading = [name.strip().lstrip("#") for name in next(reader, [])]
        return [dict(zip(heading, row, strict=False)) for row in reader if row]


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan
