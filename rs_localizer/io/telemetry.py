# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Gyroscope, accelerometer, exposure and readout time inside videos, and in phones' logs beside.

Inside videos, by telemetry-parser: GoPro, DJI, Insta360, Sony, Canon and others write them; the
library (extra ``video``) knows their formats and turns all to one orientation. Its axes in those of
the camera are gyroflow's
``(-y, x, z)``, whose y is up and z backward. On GoPro's sample of a HERO5 the gyroscope about the
vertical agrees with the motion of the image (correlation 0.99), and gravity points down.
"""

from __future__ import annotations

import csv
import functools
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera

# Optical axes (x right, y down, z forward) from telemetry-parser's.
CAMERA_FROM_SENSOR = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# What announces telemetry in the first or the last bytes of a file: GoPro, DJI, Sony, Insta360.
_MARKS = (b"gpmd", b"djmd", b"rtmd", b"8db42d694ccc418790edff439fe026bf")
_LOOKED_AT = 2**18  # bytes
_MOST_TRACKS = 2**26  # bytes, for a file that lies: a day at 60 Hz
# Readout times in ms: of GoPro (SROT; of HERO7 for each image), Sony and Canon, and those that add
# it themselves.
_READOUT_NAMES = ("0x53524f54", "FrameReadoutTime", "frame_readout_time")
_STABILIZED, _STABILIZER = "0x45495345", "0x45495341"  # GoPro: EISE, whether, and EISA, how
_OFF = ("", "N", "N/A", "OFF")
# Models of gyroflow's lens profiles that OpenCV has as well; without a name it is the fisheye.
_LENSES = {"opencv_fisheye": "equidistant", "opencv_standard": "plumb_bob"}
_MEI = "insta360"
_ANGLES = 200  # of a lens, to fit another model to: more change nothing
_FIELD, _DIAGONAL = "0x56464f56", "0x5a464f56"  # GoPro: VFOV, its letter, and ZFOV, degrees


class TelemetryError(ValueError):
    """Telemetry that cannot be read; the message names the video."""


@dataclass(frozen=True, slots=True, eq=False)
class Telemetry:
    """What a video says of its camera and of its motion."""

    camera: str  # its name
    times: Array  # (n,) s of the video's clock
    rates: Array  # (n,3) rad/s, optical axes of the camera
    forces: Array  # (n,3) m/s^2, specific force in these axes; NaN where it is not measured
    readout_time: float | None  # s
    exposure: float | None  # s, median
    stabilizer: str = ""  # what has changed the images; empty: nothing that is known
    lens: str = ""  # its setting
    profile: Camera | None = None  # its lens, where the maker's profile is of a model of ours

    @property
    def rate(self) -> float:
        """Readings of the gyroscope per second."""
        return float((len(self.times) - 1) / (self.times[-1] - self.times[0]))


def has_telemetry(path: Path) -> bool:
    """Whether a file looks as if it had any, without reading it."""
    size = path.stat().st_size
    with path.open("rb") as file:
        looked_at = file.read(_LOOKED_AT)
        file.seek(max(0, size - _LOOKED_AT))
        looked_at += file.read(_LOOKED_AT) + _tracks(file)
    return any(mark in looked_at for mark in _MARKS)


def _tracks(file: BinaryIO) -> bytes:
    """The box of an MP4 that lists its tracks: megabytes, of long videos; empty: none."""
    at = file.seek(0)
    while len(start := file.read(16)) >= 8:
        size, kind = struct.unpack(">I4s", start[:8])
        if size == 1:
            size = int.from_bytes(start[8:], "big")
        if kind == b"moov" or size < 8:
            return start + file.read(min(size, _MOST_TRACKS)) if kind == b"moov" else b""
        at = file.seek(at + size)
    return b""


@functools.lru_cache(maxsize=1)
def read_telemetry(path: Path) -> Telemetry | None:
    """The telemetry of a video; None: it has no gyroscope.

    Raises:
        TelemetryError: when it cannot be read.
        ImportError: without telemetry-parser.
    """
    import telemetry_parser

    try:
        parser = telemetry_parser.Parser(str(path))
        samples = parser.normalized_imu()
        tags = parser.telemetry(False)
    except Exception as error:  # the library's own, of any kind
        raise TelemetryError(
            f"{path}: its telemetry cannot be read, --no-telemetry goes on without: {error}"
        ) from error
    turning = [sample for sample in samples if sample["gyro"] is not None]
    if turning:
        times = np.array([sample["timestamp_ms"] for sample in turning]) * 1e-3
        read = np.radians(np.array([sample["gyro"] for sample in turning], float))
        rates = read @ CAMERA_FROM_SENSOR.T
    else:
        times, rates = _of_orientations(tags)
    if len(times) < 2:
        return None
    forces = np.array([sample["accl"] for sample in samples if sample["accl"] is not None], float)
    found = _values(tags)
    exposures = [
        item
        for group in tags
        for item in np.ravel(group.get("Exposure", {}).get("Data", []))
        if isinstance(item, float)
    ]
    readout = next((found[name] for name in _READOUT_NAMES if name in found), None)
    stabilizer = str(found.get(_STABILIZER, "")).strip()
    if found.get(_STABILIZED) == "N" or stabilizer.upper() in _OFF:
        stabilizer = "electronic stabilization" if found.get(_STABILIZED) == "Y" else ""
    return Telemetry(
        " ".join(dict.fromkeys(f"{parser.camera} {parser.model or ''}".split())),
        times,
        rates,
        _spread(forces, times) @ CAMERA_FROM_SENSOR.T,
        None if readout is None or not float(readout) > 0.0 else 1e-3 * float(readout),
        float(np.median(exposures)) if exposures else None,
        stabilizer,
        _lens(found, tags),
        _profile(tags),
    )


def _of_orientations(tags: list[dict[str, Any]]) -> tuple[Array, Array]:
    """Times (n,) s and rates (n,3) rad/s of a camera that writes how it is turned instead (DJI).

    The library has orientations of a camera with x right, y up and z back. GoPros write both: rates
    from their orientations are those of the gyroscope, by scales of 1.00 +- 0.01 about each axis.
    """
    rows = [row for group in tags for row in group.get("Quaternion", {}).get("Data", [])]
    rows = sorted({1e-3 * row["t"]: row["v"] for row in rows}.items(), key=lambda item: item[0])
    if len(rows) < 2:
        return np.zeros(0), np.zeros((0, 3))
    times = np.array([time for time, _ in rows])
    turns = Rotation.from_quat([[value[axis] for axis in "xyzw"] for _, value in rows])
    steps = (turns[:-1].inv() * turns[1:]).as_rotvec() / np.diff(times)[:, None]
    return 0.5 * (times[1:] + times[:-1]), steps * [1.0, -1.0, -1.0]


def _lens(values: dict[str, Any], tags: list[dict[str, Any]]) -> str:
    """A profile, or the setting of a GoPro's lens: each needs a calibration of its own."""
    if kept := _kept_profile(tags):
        fx = float(np.ravel(kept["fisheye_params"]["camera_matrix"])[0])
        model = kept.get("distortion_model") or "opencv_fisheye"
        return f"lens profile by {kept.get('calibrated_by') or 'its maker'} ({model}, {fx:.0f} px)"
    letter, degrees = values.get(_FIELD), values.get(_DIAGONAL)
    if letter is None:
        return ""
    return f"field of view {letter}" + ("" if degrees is None else f" ({float(degrees):.0f} deg)")


def _kept_profile(tags: list[dict[str, Any]]) -> dict[str, Any]:
    """The lens profile in gyroflow's format; empty: there is none with a camera matrix."""
    for group in tags:
        data = group.get("Lens", {}).get("Data")
        if isinstance(data, dict) and "camera_matrix" in (data.get("fisheye_params") or {}):
            return data
    return {}


def _profile(tags: list[dict[str, Any]]) -> Camera | None:
    """The camera of a lens profile, as far as its model is one of ours."""
    kept = _kept_profile(tags)
    name = (kept.get("distortion_model") or "opencv_fisheye") if kept else ""
    if name not in (*_LENSES, _MEI):
        return None
    size, lens = kept["calib_dimension"], kept["fisheye_params"]
    try:
        K, D = np.array(lens["camera_matrix"], float), lens["distortion_coeffs"]
        if name == _MEI:
            K, D = _equidistant(K, np.array(D, float), 0.5 * min(size["w"], size["h"]))
        return Camera(size["w"], size["h"], K, D, _LENSES.get(name, "equidistant"))
    except ValueError:  # of a model that has grown, or numbers that are none
        return None


def _equidistant(K: Array, D: Array, radius: float) -> tuple[Array, Array]:
    """The equidistant lens nearest to one of Mei and Rives, over the image circle.

    Mei and Rives, "Single view point omnidirectional camera calibration from planar grids" (ICRA
    2007): a bearing on the unit sphere, seen from ``xi`` behind its centre, then a polynomial. The
    two differ by some hundredths of a pixel; what decentres (p1, p2) is left out, a pixel at the
    rim where they are 1e-4.

    Args:
        K: (3,3) camera matrix.
        D: k1, k2, k3, p1, p2, xi.
        radius: of the circle, px.
    """
    k1, k2, k3, _, _, xi = D
    angles = np.linspace(0.0, np.pi, _ANGLES, endpoint=False)[1:]
    with np.errstate(all="ignore"):
        m = np.sin(angles) / (np.cos(angles) + xi)
        radii = m * (1.0 + k1 * m**2 + k2 * m**4 + k3 * m**6)
        grows = np.diff(radii, prepend=0.0) > 0.0
    # As far as radii grow, and the image reaches.
    inside = np.logical_and.accumulate(grows & (np.cos(angles) > -xi) & (K[0, 0] * radii < radius))
    angles, radii = angles[inside], radii[inside]
    powers = angles[:, None] ** np.arange(1, 10, 2)
    focal, *rest = np.linalg.lstsq(powers, radii, rcond=None)[0]
    scaled = K.copy()
    scaled[[0, 1], [0, 1]] *= focal
    return scaled, np.array(rest) / focal


def _spread(forces: Array, times: Array) -> Array:
    """Specific forces (k,3) at the times (n,) of the gyroscope.

    The library numbers both alike, so that those of a slower accelerometer come too early: they
    are as long as the gyroscope's, at a rate of their own.
    """
    if len(forces) < 2:
        return np.full((len(times), 3), np.nan)
    if len(forces) == len(times):
        return forces
    span = times[-1] - times[0]
    own = times[0] + span * np.arange(len(forces)) / (len(forces) - 1)
    return np.stack([np.interp(times, own, column) for column in forces.T], axis=1)


def _values(tags: list[dict[str, Any]]) -> dict[str, Any]:
    """Values by name, whatever group they stand in; of one name, and of a list, the first."""
    found: dict[str, Any] = {}
    for part in reversed([part for groups in tags for part in groups.values()]):
        if isinstance(part, dict):
            nested = [item for item in part.values() if isinstance(item, dict)]
            for items in (*nested, part):
                first = {k: v[0] if isinstance(v, list) and v else v for k, v in items.items()}
                found |= {k: v for k, v in first.items() if isinstance(v, (str, int, float))}
    return found


_STANDARD_GRAVITY = 9.80665  # m/s^2 in a g
# Readings of an accelerometer below this (median) are in g, as those of Core Motion.
_MOST_G = 3.0
_LEAST_READINGS = 2
# Columns: three numbers and a time, or a time and twice three.
_SEPARATE, _TOGETHER = 4, 7


@dataclass(frozen=True, slots=True)
class _Log:
    """The files of a recording."""

    app: str
    readings: Path
    frames: Path
    forces: Path | None = None  # where the accelerometer has a file of its own


def read_log(video: Path) -> Telemetry | None:
    """What apps of phones write beside a video, by its clock; None: nothing that is known.

    Read are MARS Logger (Android and iOS: ``gyro_accel.csv``, ``movie_metadata.csv``), OpenCamera
    Sensors (``VIDEO_gyro.csv``, ``VIDEO_accel.csv``, ``VIDEO_timestamps.csv``) and Stray Scanner
    (``imu.csv``, ``odometry.csv``). Phones have one orientation: x to the right of the screen, y
    up, z out of it; the rows of the camera behind it run from its top to its bottom, so that an
    upright phone's images lie on their side, their x axis pointing down. ``calibrate --imu`` checks
    it.

    The first image is taken to be at time 0 of the video.

    Raises:
        TelemetryError: when it cannot be read, naming the file.
    """
    log = _find(video)
    if log is None:
        return None
    columns, clock = (_SEPARATE, 3) if log.forces is not None else (_TOGETHER, 0)
    readings, frames = _Table.read(log.readings, columns, clock), _Table.read(log.frames, 1)
    stamps = frames.named("timestamp")
    starts = (frames.values[:, 0] if stamps is None else stamps) * frames.second
    exposure = _median(frames.named("exposure time"), frames.second)
    readout = _median(frames.named("frame readout time"), frames.second)
    if log.forces is not None:  # x, y, z, time
        times, rates = readings.values[:, 3] * 1e-9, readings.values[:, :3]
        other = _Table.read(log.forces, _SEPARATE, clock).values
        forces = np.stack([np.interp(times, other[:, 3] * 1e-9, other[:, k]) for k in range(3)], 1)
    elif readings.has("a_x"):
        times, forces, rates = np.split(readings.values[:, :7], [1, 4], axis=1)
        times = times[:, 0]
    else:
        times, rates, forces = np.split(readings.values[:, :7], [1, 4], axis=1)
        times = times[:, 0] * readings.second
    if np.median(np.linalg.norm(forces, axis=1)) < _MOST_G:
        forces = -_STANDARD_GRAVITY * forces  # Core Motion has gravity, not what holds against it
    if times[-1] < starts.min() or times[0] > starts.max():
        raise TelemetryError(
            f"{log.readings} and {log.frames.name} are not of one time: {times[0]:.1f} to "
            f"{times[-1]:.1f} s, {starts.min():.1f} to {starts.max():.1f} s"
        )
    # Stamps are of the start of the first row's exposure, as Android has them; here of its middle.
    begin = starts[0] + 0.5 * (exposure or 0.0)
    return Telemetry(
        f"{log.app} ({log.readings.name})",
        times - begin,
        rates @ CAMERA_FROM_SENSOR.T,
        forces @ CAMERA_FROM_SENSOR.T,
        readout,
        exposure,
    )


def _find(video: Path) -> _Log | None:
    folder, name = video.parent, video.stem
    candidates = [
        _Log("MARS Logger", folder / "gyro_accel.csv", folder / "movie_metadata.csv"),
        _Log("Stray Scanner", folder / "imu.csv", folder / "odometry.csv"),
    ]
    for place in (folder, folder / name.removeprefix("VID_")):
        for joint in ("_", ""):
            files = (place / f"{name}{joint}{what}.csv" for what in ("gyro", "timestamps", "accel"))
            candidates.append(_Log("OpenCamera Sensors", *files))
    for log in candidates:
        if all(file is None or file.is_file() for file in (log.readings, log.frames, log.forces)):
            return log
    return None


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """A file of numbers, with a heading or without."""

    path: Path
    names: list[str]  # of the columns; empty: the file has no heading
    values: Array  # (n,m); NaN for what is no number

    @staticmethod
    def read(path: Path, columns: int, clock: int | None = None) -> _Table:
        """Refuses a file whose first columns are no numbers; orders rows by the column of times."""
        try:
            text = path.read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            raise TelemetryError(f"{path} cannot be read: {error}") from error
        lines = [line for line in text.splitlines() if line.strip() and line[0] != "#"]
        rows = list(csv.reader(lines, skipinitialspace=True))
        names: list[str] = []
        if rows and np.isnan(_number(rows[0][0])):
            names = [word.strip().lower() for word in rows.pop(0)]
        width = len(rows[0]) if rows else 0
        values = [[_number(word) for word in row] for row in rows if len(row) == width]
        table = np.array(values).reshape(-1, max(width, 1))
        if len(values) < _LEAST_READINGS or width < columns:
            raise TelemetryError(
                f"{path} has no readings: {len(values)} lines of {width} numbers, {columns} or "
                "more are needed"
            )
        known = np.isfinite(table[:, :columns]).all(axis=1)
        if not known.all():
            worst = ", ".join(rows[int(np.argmin(known))])
            raise TelemetryError(f"{path} has {np.sum(~known)} lines without a number, as {worst}")
        if clock is not None:
            table = table[np.unique(table[:, clock], return_index=True)[1]]
        return _Table(path, names, table)

    @property
    def second(self) -> float:
        """What its unit of time is in s: the heading says so, or they are ns."""
        return 1.0 if self.has("[sec]") or self.names[:1] == ["timestamp"] else 1e-9

    def has(self, word: str) -> bool:
        return any(word in name for name in self.names)

    def named(self, word: str) -> Array | None:
        """The column of which the name begins so."""
        for k, name in enumerate(self.names):
            if name.startswith(word):
                return self.values[:, k]
        return None


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return float("nan")


def _median(column: Array | None, unit: float) -> float | None:
    """Of what is known and positive, s."""
    if column is None or not np.any(column > 0.0):
        return None
    return float(np.median(column[column > 0.0])) * unit
