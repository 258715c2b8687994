# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Gyroscope, accelerometer, exposure and readout time inside videos, by telemetry-parser.

GoPro, DJI, Insta360, Sony, Canon and others write them; the library (extra ``video``) knows their
formats and turns all to one orientation. Its axes in those of the camera are gyroflow's
``(-y, x, z)``, whose y is up and z backward. On GoPro's sample of a HERO5 the gyroscope about the
vertical agrees with the motion of the image (correlation 0.99), and gravity points down.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array

# Optical axes (x right, y down, z forward) from telemetry-parser's.
CAMERA_FROM_SENSOR = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# What announces telemetry in the first or the last bytes of a file: GoPro, DJI, Sony, Insta360.
_MARKS = (b"gpmd", b"djmd", b"rtmd", b"8db42d694ccc418790edff439fe026bf")
_LOOKED_AT = 2**18  # bytes
# Readout times in ms: of GoPro (SROT), Sony and Canon, and those that add it themselves.
_READOUT_NAMES = ("0x53524f54", "FrameReadoutTime", "frame_readout_time")
_STABILIZED, _STABILIZER = "0x45495345", "0x45495341"  # GoPro: EISE, whether, and EISA, how
_OFF = ("", "N", "N/A", "OFF")
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

    @property
    def rate(self) -> float:
        """Readings of the gyroscope per second."""
        return float((len(self.times) - 1) / (self.times[-1] - self.times[0]))


def has_telemetry(path: Path) -> bool:
    """Whether a file looks as if it had any, without reading it."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_LOOKED_AT)
        file.seek(max(0, size - _LOOKED_AT))
        ends = head + file.read(_LOOKED_AT)
    return any(mark in ends for mark in _MARKS)


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
        raise TelemetryError(f"{path}: its telemetry cannot be read: {error}") from error
    turning = [sample for sample in samples if sample["gyro"] is not None]
    if len(turning) < 2:
        return None
    times = np.array([sample["timestamp_ms"] for sample in turning]) * 1e-3
    rates = np.radians(np.array([sample["gyro"] for sample in turning], float))
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
        rates @ CAMERA_FROM_SENSOR.T,
        _spread(forces, times) @ CAMERA_FROM_SENSOR.T,
        None if readout is None or not float(readout) > 0.0 else 1e-3 * float(readout),
        float(np.median(exposures)) if exposures else None,
        stabilizer,
        _lens(found),
    )


def _lens(values: dict[str, Any]) -> str:
    """The setting of a GoPro's lens: each needs a calibration of its own."""
    letter, degrees = values.get(_FIELD), values.get(_DIAGONAL)
    if letter is None:
        return ""
    return f"field of view {letter}" + ("" if degrees is None else f" ({float(degrees):.0f} deg)")


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
    """Single values by name, whatever group they stand in; of one name, the first."""
    found: dict[str, Any] = {}
    for part in reversed([part for groups in tags for part in groups.values()]):
        if isinstance(part, dict):
            nested = [item for item in part.values() if isinstance(item, dict)]
            for items in (*nested, part):
                found |= {k: v for k, v in items.items() if isinstance(v, (str, int, float))}
    return found
