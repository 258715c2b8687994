# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Gyroscope, accelerometer, exposure and readout time that apps of phones write beside a video.

Read are MARS Logger (Android and iOS: ``gyro_accel.csv``, ``movie_metadata.csv``), OpenCamera
Sensors (``VIDEO_gyro.csv``, ``VIDEO_accel.csv``, ``VIDEO_timestamps.csv``) and Stray Scanner
(``imu.csv``, ``odometry.csv``). Phones have one orientation: x to the right of the screen, y up, z
out of it; the rows of the camera behind it run from its top to its bottom, so that an upright
phone's images lie on their side, their x axis pointing down. ``calibrate --imu`` checks it.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.io.telemetry import CAMERA_FROM_SENSOR, Telemetry, TelemetryError

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
    """What stands beside a video, by the clock of the video; None: nothing that is known.

    The first image is taken to be at time 0 of the video.

    Raises:
        TelemetryError: when it cannot be read, naming the file.
    """
    log = _find(video)
    if log is None:
        return None
    columns = _SEPARATE if log.forces is not None else _TOGETHER
    readings, frames = _Table.read(log.readings, columns), _Table.read(log.frames, 1)
    starts = frames.column("timestamp", 0) * frames.second
    exposure = _median(frames.named("exposure time"), frames.second)
    readout = _median(frames.named("frame readout time"), frames.second)
    if log.forces is not None:  # x, y, z, time
        times, rates = readings.values[:, 3] * 1e-9, readings.values[:, :3]
        other = _Table.read(log.forces, _SEPARATE).values
        forces = np.stack([np.interp(times, other[:, 3] * 1e-9, other[:, k]) for k in range(3)], 1)
    elif readings.has("a_x"):
        times, forces, rates = np.split(readings.values[:, :7], [1, 4], axis=1)
        times = times[:, 0]
    else:
        times, rates, forces = np.split(readings.values[:, :7], [1, 4], axis=1)
        times = times[:, 0] * readings.second
    if np.median(np.linalg.norm(forces, axis=1)) < _MOST_G:
        forces = -_STANDARD_GRAVITY * forces  # Core Motion has gravity, not what holds against it
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
    def read(path: Path, columns: int) -> _Table:
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
        usable = len(values) >= _LEAST_READINGS and width >= columns
        if not usable or not np.isfinite(table[:, :columns]).all():
            raise TelemetryError(
                f"{path} has no readings: {len(values)} lines of {width} numbers, {columns} or "
                "more are needed"
            )
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

    def column(self, word: str, place: int) -> Array:
        found = self.named(word)
        return self.values[:, place] if found is None else found


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
