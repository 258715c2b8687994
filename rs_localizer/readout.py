# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Published readout times of cameras: from the first row to the last, ``height - 1`` line times."""

import csv
import difflib
from dataclasses import asdict, dataclass

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
    """Return the whole table."""
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
    """Return all modes whose camera has the words of ``name``, and whose mode those of ``mode``.

    All matches are returned: the caller chooses.

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
    """Return an entry by identifiers with units."""
    values: dict[str, object] = {
        f"{key}_s" if isinstance(value, float) else key: value
        for key, value in asdict(entry).items()
    } | {"upper_bound": entry.upper_bound}
    return {k: float(f"{v:.6g}") if isinstance(v, float) else v for k, v in values.items()}


def _has(text: str, words: str) -> bool:
    return all(word in text.lower() for word in words.lower().split())
