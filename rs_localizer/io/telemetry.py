# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Gyroscope, accelerometer and readout time inside videos, by telemetry-parser.

GoPro, DJI, Insta360, Sony, Canon and others write them; the library (extra ``video``) knows their
formats and turns all to one orientation. Its axes in those of the camera are gyroflow's
``(-y, x, z)``, whose y is up and z backward. On GoPro's sample of a HERO5 the gyroscope about the
vertical agrees with the motion of the image (correlation 0.99), and gravity points down. It works
in a process of its own (:mod:`rs_localizer.io.telemetry_process`); its numbers are checked here.
"""

from __future__ import annotations

import functools
import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.io.reading import LimitedError, run_limited

# Optical axes (x right, y down, z forward) from telemetry-parser's.
CAMERA_FROM_SENSOR = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# Marks of telemetry in the first or the last bytes of a file: GoPro, DJI, Sony, Insta360.
_MARKS = (b"gpmd", b"djmd", b"rtmd", b"8db42d694ccc418790edff439fe026bf")
_LOOKED_AT = 2**18  # bytes
_MOST_TRACKS = 2**26  # bytes, for a file that lies: a day at 60 Hz
_SCRIPT = Path(__file__).with_name("telemetry_process.py")
# Limits of the process: memory in bytes, beside this many for each byte of the file, and time (s).
_MEMORY, _A_BYTE, _MOST_MEMORY = 400_000_000, 4, 6_000_000_000
_SECONDS, _BYTES_A_SECOND = 5, 50_000_000
# Gyroscopes end at 70 rad/s (4000 deg/s); readout times of cameras at 0.2 s.
_FASTEST, _LONGEST_READOUT = 100.0, 200.0  # rad/s, ms
_KEPT = 0.9  # least share of readings that can be used
# Readout times in ms: of GoPro (SROT; of HERO7 for each image), Sony and Canon, those that add it
# themselves, and Insta360.
_READOUT_NAMES = ("0x53524f54", "FrameReadoutTime", "frame_readout_time", "rolling_shutter_time")
_STABILIZED, _STABILIZER = "0x45495345", "0x45495341"  # GoPro: EISE, whether, and EISA, how
_OFF = ("", "N", "N/A", "OFF")


class TelemetryError(ValueError):
    """Telemetry that cannot be read; the message names the video."""


@dataclass(frozen=True, slots=True, eq=False)
class Telemetry:
    """Camera and motion, by the telemetry of a video."""

    camera: str  # its name
    times: Array  # (n,) s of the video's clock
    rates: Array  # (n,3) rad/s, optical axes of the camera
    forces: Array  # (n,3) m/s^2, specific force in these axes; NaN where it is not measured
    readout_time: float | None  # s
    stabilizer: str = ""  # what has changed the images; empty: nothing that is known

    @property
    def rate(self) -> float:
        """Readings of the gyroscope per second."""
        return float((len(self.times) - 1) / (self.times[-1] - self.times[0]))


def has_telemetry(path: Path) -> bool:
    """Return True for a file that seems to have telemetry, without reading it."""
    with path.open("rb") as file:
        looked_at = file.read(_LOOKED_AT)
        file.seek(max(0, path.stat().st_size - _LOOKED_AT))
        looked_at += file.read(_LOOKED_AT) + _tracks(file)
    return any(mark in looked_at for mark in _MARKS)


def _tracks(file: BinaryIO) -> bytes:
    """Return the box of an MP4 that lists its tracks, megabytes for long videos; may be empty."""
    at = file.seek(0)
    while len(start := file.read(16)) >= 8:
        size, kind = struct.unpack(">I4s", start[:8])
        if size == 1:
            size = int.from_bytes(start[8:], "big")
        if kind == b"moov" or not 8 <= size < 2**62:
            return start + file.read(min(size, _MOST_TRACKS)) if kind == b"moov" else b""
        at = file.seek(at + size)
    return b""


@functools.lru_cache(maxsize=1)
def read_telemetry(path: Path) -> Telemetry | None:
    """Read the telemetry of a video; None if it has no gyroscope.

    Raises:
        TelemetryError: when it cannot be read, or is more than such a file can hold.
    """
    size = path.stat().st_size
    memory = min(_MEMORY + _A_BYTE * size, _MOST_MEMORY)
    seconds = _SECONDS + size // _BYTES_A_SECOND
    try:
        return interpreted(run_limited(_SCRIPT, {"path": str(path)}, memory, seconds))
    except (LimitedError, TelemetryError) as error:
        raise TelemetryError(
            f"{path}: its telemetry cannot be read (ffmpeg -i IN -map 0:v -c copy OUT goes on "
            f"without): {error}"
        ) from error


def interpreted(found: dict[str, Any]) -> Telemetry | None:
    """Interpret numbers and words of :mod:`rs_localizer.io.telemetry_process`.

    Raises:
        TelemetryError: for numbers that no gyroscope gives.
    """
    said = json.loads(str(found["said"]))
    if len(found["gyroscope"]):
        read = found["gyroscope"] * [1e-3, *np.radians(np.ones(3))]
        times, rates = read[:, 0], read[:, 1:] @ CAMERA_FROM_SENSOR.T
    else:
        times, rates = _of_orientations(found["turns"])
    times, rates = _plausible(times, rates)
    if len(times) < 2:
        return None
    values = said["values"]
    readout = next((_number(values[name]) for name in _READOUT_NAMES if name in values), np.nan)
    stabilizer = str(values.get(_STABILIZER, "")).strip()
    if values.get(_STABILIZED) == "N" or stabilizer.upper() in _OFF:
        stabilizer = "electronic stabilization" if values.get(_STABILIZED) == "Y" else ""
    return Telemetry(
        said["name"],
        times,
        rates,
        _spread(found["accelerometer"][:, 1:], times) @ CAMERA_FROM_SENSOR.T,
        1e-3 * readout if 0.0 < readout < _LONGEST_READOUT else None,
        stabilizer,
    )


def _plausible(times: Array, rates: Array) -> tuple[Array, Array]:
    """Return the plausible readings of a gyroscope, at rising times; nearly all have to be."""
    usable = np.isfinite(times) & np.all(np.abs(rates) < _FASTEST, axis=1)
    latest = np.maximum.accumulate(np.where(usable, times, -np.inf))
    usable &= np.append(-np.inf, latest[:-1]) < times if len(times) else usable
    if np.count_nonzero(usable) < _KEPT * len(times):
        raise TelemetryError(
            f"of {len(times)} readings of the gyroscope, {np.count_nonzero(~usable)} are no "
            "numbers of one, or of times that do not rise"
        )
    return times[usable], rates[usable]


def _of_orientations(rows: Array) -> tuple[Array, Array]:
    """Return times (n,) s and rates (n,3) rad/s of a camera that writes orientations (DJI).

    The library has orientations of a camera with x right, y up and z back. GoPros write
    orientations and rates: the rates from the orientations equal the gyroscope's, with scales of
    1.00 +- 0.01 about each axis.

    Args:
        rows: (k,5) ms, x y z w; one of a time counts.
    """
    rows = rows[np.isfinite(rows).all(axis=1) & (np.linalg.norm(rows[:, 1:], axis=1) > 0.5)]
    times, first = np.unique(1e-3 * rows[:, 0], return_index=True)
    if len(times) < 2:
        return np.zeros(0), np.zeros((0, 3))
    unit = rows[first, 1:] / np.linalg.norm(rows[first, 1:], axis=1)[:, None]
    before, after, w, later = unit[:-1, :3], unit[1:, :3], unit[:-1, 3:], unit[1:, 3:]
    sines = w * after - later * before - np.cross(before, after)  # of half the angles, about axes
    cosines = w * later + np.sum(before * after, axis=1)[:, None]
    sizes = np.linalg.norm(sines, axis=1)[:, None]
    angles = 2.0 * np.arctan2(sizes, np.abs(cosines)) * np.where(cosines < 0.0, -1.0, 1.0)
    steps = sines * np.divide(angles, sizes, out=np.full_like(sizes, 2.0), where=sizes > 0.0)
    return 0.5 * (times[1:] + times[:-1]), steps / np.diff(times)[:, None] * [1.0, -1.0, -1.0]


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return np.nan


def _spread(forces: Array, times: Array) -> Array:
    """Interpolate specific forces (k,3) at the times (n,) of the gyroscope.

    The library numbers both alike, so that the samples of a slower accelerometer come too early.
    Both cover the same time, at rates of their own.
    """
    if len(forces) < 2:
        return np.full((len(times), 3), np.nan)
    if len(forces) == len(times):
        return forces
    span = times[-1] - times[0]
    own = times[0] + span * np.arange(len(forces)) / (len(forces) - 1)
    return np.stack([np.interp(times, own, column) for column in forces.T], axis=1)
