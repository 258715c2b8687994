# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Gyroscope, accelerometer, readout time and lens inside videos, by telemetry-parser.

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
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.camera_files import gyroflow_camera
from rs_localizer.io.limited import LimitedError, run_limited

# Optical axes (x right, y down, z forward) from telemetry-parser's.
CAMERA_FROM_SENSOR = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# What announces telemetry in the first or the last bytes of a file: GoPro, DJI, Sony, Insta360.
_MARKS = (b"gpmd", b"djmd", b"rtmd", b"8db42d694ccc418790edff439fe026bf")
_LOOKED_AT = 2**18  # bytes
_MOST_TRACKS = 2**26  # bytes, for a file that lies: a day at 60 Hz
_SCRIPT = Path(__file__).with_name("telemetry_process.py")
# Of the process: bytes beside so many for each byte of the file, and s beside a slow disk's.
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
_MEI = "insta360"
_ANGLES = 200  # of a lens, to fit another model to: more change nothing


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
    lens: str = ""  # what its profile says
    profile: Camera | None = None  # its lens, where the maker's profile is of a model of ours

    @property
    def rate(self) -> float:
        """Readings of the gyroscope per second."""
        return float((len(self.times) - 1) / (self.times[-1] - self.times[0]))


def has_telemetry(path: Path) -> bool:
    """True for a file that looks as if it had any, without reading it."""
    with path.open("rb") as file:
        looked_at = file.read(_LOOKED_AT)
        file.seek(max(0, path.stat().st_size - _LOOKED_AT))
        looked_at += file.read(_LOOKED_AT) + _tracks(file)
    return any(mark in looked_at for mark in _MARKS)


def _tracks(file: BinaryIO) -> bytes:
    """The box of an MP4 that lists its tracks: megabytes, of long videos; empty: none."""
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
    """The telemetry of a video; None: it has no gyroscope.

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
    """Telemetry of the numbers and words of :mod:`rs_localizer.io.telemetry_process`.

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
    values, profile = said["values"], said["profile"]
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
        _lens(profile),
        _profile(profile),
    )


def _plausible(times: Array, rates: Array) -> tuple[Array, Array]:
    """The readings that are numbers of a gyroscope, at times that rise; nearly all have to be."""
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
    """Times (n,) s and rates (n,3) rad/s of a camera that writes how it is turned instead (DJI).

    The library has orientations of a camera with x right, y up and z back. GoPros write both: rates
    from their orientations are those of the gyroscope, by scales of 1.00 +- 0.01 about each axis.

    Args:
        rows: (k,5) ms, x y z w; one of a time counts.
    """
    rows = rows[np.isfinite(rows).all(axis=1) & (np.linalg.norm(rows[:, 1:], axis=1) > 0.5)]
    times, first = np.unique(1e-3 * rows[:, 0], return_index=True)
    if len(times) < 2:
        return np.zeros(0), np.zeros((0, 3))
    turns = Rotation.from_quat(rows[first, 1:])
    steps = (turns[:-1].inv() * turns[1:]).as_rotvec() / np.diff(times)[:, None]
    return 0.5 * (times[1:] + times[:-1]), steps * [1.0, -1.0, -1.0]


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return np.nan


def _lens(profile: dict[str, Any]) -> str:
    """What a lens profile says; each needs a calibration of its own."""
    fisheye = profile.get("fisheye_params")
    if not isinstance(fisheye, dict) or "camera_matrix" not in fisheye:
        return ""
    model = profile.get("distortion_model") or "opencv_fisheye"
    fx = _number(next(iter(np.ravel(np.array(fisheye["camera_matrix"], object))), None))
    return f"lens profile by {profile.get('calibrated_by') or 'its maker'} ({model}, {fx:.0f} px)"


def _profile(profile: dict[str, Any]) -> Camera | None:
    """The camera of a lens profile in gyroflow's format, as far as its model is one of ours."""
    try:
        if profile.get("distortion_model") == _MEI:
            size, lens = profile["calib_dimension"], profile["fisheye_params"]
            names = ("camera_matrix", "distortion_coeffs")
            K, D = (np.array(lens[name], float) for name in names)
            fitted = _equidistant(K, D, 0.5 * min(size["w"], size["h"]))
            lens = {name: part.tolist() for name, part in zip(names, fitted, strict=True)}
            profile = profile | {"fisheye_params": lens, "distortion_model": "opencv_fisheye"}
        return gyroflow_camera(profile)
    except (KeyError, TypeError, ValueError, OverflowError, np.linalg.LinAlgError):
        return None


def _equidistant(K: Array, D: Array, radius: float) -> tuple[Array, Array]:
    """The equidistant lens nearest to one of Mei and Rives, over the image circle.

    Mei and Rives, "Single view point omnidirectional camera calibration from planar grids" (ICRA
    2007): a bearing on the unit sphere, seen from ``xi`` behind its centre, then a polynomial. The
    two differ by some hundredths of a pixel; what decentres (p1, p2) is left out, a pixel at the
    rim where they are 1e-4. ``D``: k1, k2, k3, p1, p2, xi; ``radius`` of the circle, px.
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
    if not focal > 0.0:
        raise ValueError("the lens has no image")
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
