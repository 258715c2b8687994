# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Published readout times of cameras, and how their conventions become ours.

Ours: ``readout_time`` runs from the first row to the last, ``height - 1`` line times;
``stamp_offset`` from the stamp to the middle of the first row's exposure.
"""

from __future__ import annotations

import csv
import difflib
import re
from dataclasses import asdict, dataclass
from enum import StrEnum

from rs_localizer import data

_TABLE = "readout_times/table.csv"
_COLUMNS = ("name", "mode", "median_ms", "low_ms", "high_ms", "number", "source")
# Of which nobody has published a readout time that names its mode.
COMMON = (
    "Logitech C920", "Logitech C270", "Logitech Brio", "Intel RealSense D435", "Luxonis OAK-D",
    "Stereolabs ZED 2", "Microsoft Azure Kinect", "Raspberry Pi Camera 3",
    "Raspberry Pi HQ Camera", "Orbbec Gemini 2",
)  # fmt: skip
MEASURE = (
    "measure it: film a printed chessboard for 20 s, the camera moving as it will, and run "
    "rs_localizer calibrate VIDEO --board 9x6 --square 0.025 --out camera.yaml"
)
# Of the interval between images: who writes this much has rather an upper bound than a measurement.
_UPPER_BOUND = 0.95


@dataclass(frozen=True, slots=True)
class Known:
    """Published readout times of one mode of a camera."""

    name: str
    mode: str
    median: float  # s
    low: float  # s, quartiles of what was said
    high: float  # s
    number: int  # of those who said it
    source: str

    @property
    def upper_bound(self) -> bool:
        """True if it is about the whole interval between images, which says little."""
        words = self.mode.split()
        rate = float(words[-2]) if words[-1] == "Hz" else 0.0
        return self.median * rate > _UPPER_BOUND


def known_cameras() -> list[Known]:
    """The whole table."""
    with data.path(_TABLE).open(encoding="utf-8", newline="") as file:
        return [
            Known(
                name=row["name"],
                mode=row["mode"],
                median=1e-3 * float(row["median_ms"]),
                low=1e-3 * float(row["low_ms"]),
                high=1e-3 * float(row["high_ms"]),
                number=int(row["number"]),
                source=row["source"],
            )
            for row in csv.DictReader(file)
        ]


def find_readout(name: str, mode: str = "") -> list[Known]:
    """All modes whose camera has the words of the name, and whose mode has those of ``mode``.

    Never one of several: who asks chooses.

    Raises:
        ValueError: when there is none, with names that are like it.
    """
    table = known_cameras()
    named = [entry for entry in table if _has(entry.name, name)]
    if not named:
        common = next((one for one in COMMON if _has(one, name)), None)
        if common is not None:
            raise ValueError(f"no readout time of {common} in its modes is known; {MEASURE}")
        names = {entry.name.lower(): entry.name for entry in table}
        near = difflib.get_close_matches(name.lower(), names, n=3, cutoff=0.5)
        hint = f"; there are {', '.join(names[one] for one in near)}" if near else ""
        raise ValueError(
            f"nothing is known of a camera {name!r}{hint} (all: rs_localizer readout); {MEASURE}"
        )
    matching = [entry for entry in named if _has(entry.mode, mode)]
    if not matching:
        modes = ", ".join(f"{entry.name}: {entry.mode}" for entry in named)
        raise ValueError(f"no mode {mode!r} of {name!r} is known, but {modes}")
    return matching


def as_json(entry: Known) -> dict[str, object]:
    """An entry, and what other programs take, by identifiers with units.

    Those of ``odm`` (OpenDroneMap's ``--rolling-shutter-readout``) and ``gyroflow``
    (``frame_readout_time``) count all rows; that of ``kalibr`` (``lineDelay``) is from row to row,
    None for a mode that does not say how many there are.
    """
    size = re.match(r"\d+x(\d+)", entry.mode)
    line = None if size is None else entry.median / (int(size[1]) - 1)
    whole = 1e3 * (entry.median + (line or 0.0))
    values: dict[str, object] = {
        f"{key}_s" if isinstance(value, float) else key: value
        for key, value in asdict(entry).items()
    }
    values |= {"upper_bound": entry.upper_bound, "kalibr_line_delay_s": line}
    values |= {"odm_readout_ms": whole, "gyroflow_readout_ms": whole}
    return {k: float(f"{v:.6g}") if isinstance(v, float) else v for k, v in values.items()}


def _has(text: str, words: str) -> bool:
    return all(word in text.lower() for word in words.lower().split())


def from_line_time(line_time: float, rows: int) -> float:
    """``readout_time`` (s) of a sensor that takes ``line_time`` (s) from row to row."""
    return line_time * (_checked_rows(rows) - 1)


def from_all_rows(duration: float, rows: int) -> float:
    """``readout_time`` (s) of a duration that counts every row, as Android's skew does."""
    return duration * (_checked_rows(rows) - 1) / rows


class StampAt(StrEnum):
    """Part of a row's exposure that a stamp stands for."""

    START = "start"
    MIDDLE = "middle"
    END = "end"


def stamp_offset(
    at: StampAt, exposure: float, *, middle_row: bool = False, readout_time: float | None = None
) -> float:
    """``stamp_offset`` (s) of a driver whose stamps are those of one moment of one row.

    Args:
        at: the moment within the exposure.
        exposure: s.
        middle_row: the row is the middle one, else the first.
        readout_time: s, needed for the middle row.

    Raises:
        ValueError: for a negative exposure, or the middle row without a readout time.
    """
    if not exposure >= 0.0:
        raise ValueError(f"the exposure must be 0 s or more, got {exposure}")
    if middle_row and readout_time is None:
        raise ValueError("stamps of the middle row need the readout time")
    to_middle = {StampAt.START: 0.5, StampAt.MIDDLE: 0.0, StampAt.END: -0.5}[StampAt(at)]
    return to_middle * exposure - (0.5 * (readout_time or 0.0) if middle_row else 0.0)


def _checked_rows(rows: int) -> int:
    if rows < 2:
        raise ValueError(f"a rolling shutter has 2 rows or more, got {rows}")
    return rows
