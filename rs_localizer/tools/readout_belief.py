# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""When a readout time is believed: stamps, deviations, and parts of a recording.

By :class:`ShutterFit` of a map whose shutter nobody knows, and by :class:`ReadoutCheck` where one
was given; :mod:`rs_localizer.tools.camera_calibration` has the evidence of a calibration.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection

# A camera's own clock keeps its stamps within this (s) of even intervals.
_MOST_JITTER = 5e-4


@dataclass(frozen=True, slots=True, eq=False)
class Stamps:
    """Images of a camera that should run evenly."""

    interval: float  # s
    jitter: float  # s rms, of the stamps about even intervals
    missing: int  # images

    @property
    def irregular(self) -> bool:
        return self.jitter > _MOST_JITTER


def examine(times: Array) -> Stamps:
    """Return the even intervals nearest to the stamps (f,), s, sorted.

    The number of intervals is counted from stamp to stamp, so that images may be missing.
    """
    steps = np.diff(times)
    interval = float(np.median(steps))
    for _ in range(3):
        counts = np.maximum(np.round(steps / interval), 1.0)
        number = np.concatenate([[0.0], np.cumsum(counts)])
        rate = np.polyfit(number, times, 1)
        interval = float(rate[0])
    even = np.polyval(rate, number)
    off = times - even
    jitter = float(np.sqrt(np.mean((off - np.median(off)) ** 2)))
    return Stamps(interval, jitter, int(number[-1]) + 1 - len(times))


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """A part of the recording on its own."""

    start: float  # s
    end: float  # s
    readout_time: float  # s
    deviation: float  # s
    camera: Camera  # with the lens of this part
    landmarks: Array  # (p,3) m, with the shape that this part finds
    delay: float = math.nan  # s, of the readings where there are some
    delay_deviation: float = math.nan  # s


# Blocks that would differ this much by chance once in a hundred recordings disagree.
_DISAGREEMENT = 0.01


def disagreement(values: Array, deviations: Array) -> float:
    """Return the factor by which deviations (b,) are too small (Birge's ratio), at least 1."""
    if len(values) < 2:
        return 1.0
    weights = deviations**-2.0
    total = float(np.sum(weights))
    mean = np.sum(weights * values) / total
    squared = float(np.sum(weights * (values - mean) ** 2))
    freedoms = len(values) - 1
    if chdtrc(freedoms, squared) > _DISAGREEMENT:
        return 1.0
    # The disagreement of the blocks is not their noise: none of them is better than the others.
    scatter = np.std(values, ddof=1) / math.sqrt(len(values))
    return max(math.sqrt(squared / freedoms), float(scatter) * math.sqrt(total))


def discrepancy(value: float, values: Array, deviations: Array) -> float:
    """Return the difference of the whole from the mean of its parts (b,), beyond noise.

    Corners that are off in all images of a part alike bend its lens and shape. The shorter it is,
    the more of the shutter is taken for those: then the whole lies beside all of its parts.
    """
    if len(values) == 0:
        return 0.0
    weights = deviations**-2.0
    mean = weights @ values / weights.sum()
    return math.sqrt(max(float((value - mean) ** 2 - 1.0 / weights.sum()), 0.0))


def apart_of(halves: tuple[Block, ...]) -> tuple[float, float]:
    """Return the difference of the readout times of two halves, and its deviation (s)."""
    if len(halves) < 2:
        return 0.0, math.inf
    one, other = halves
    noise = math.hypot(one.deviation, other.deviation)
    return abs(one.readout_time - other.readout_time), noise


# A readout time is believed beyond this many deviations, which few seconds tell: they may be too
# small by a third. And where the images' gains are so by chance less often than this: a wrong model
# that absorbs something else helps some images and harms others.
_SIGNIFICANT, _CHANCE = 4.0, 0.01


@dataclass(frozen=True, slots=True)
class ShutterFit:
    """An unknown shutter as it was found."""

    readout_time: float  # s, of the rolling shutter that fits best
    deviation: float  # s
    direction: ScanDirection
    chance: float  # that the images' gains over a global shutter are so by chance
    interval: float  # s, between the images

    @property
    def visible(self) -> bool:
        """True where the images show a rolling shutter."""
        significant = self.readout_time > _SIGNIFICANT * self.deviation
        possible = self.readout_time < self.interval  # no camera reads out for longer
        return significant and self.chance < _CHANCE and possible


# A time is another one if it differs from the given one by this many deviations, and by this (s).
_CHECK_DEVIATIONS, _CHECK_LEAST = 6.0, 0.001


@dataclass(frozen=True, slots=True)
class ReadoutCheck:
    """The readout time that keypoints show: a wrong one bends a map that still fits them."""

    given: float  # s
    estimated: float  # s; negative: against the scan direction
    deviation: float  # s

    @property
    def differs(self) -> bool:
        """True where noise does not explain the difference."""
        apart = abs(self.estimated - self.given)
        return apart > max(_CHECK_DEVIATIONS * self.deviation, _CHECK_LEAST)

    @property
    def message(self) -> str:
        """One sentence that warns of it."""
        reverse = " in the reverse direction" if self.estimated < 0.0 else ""
        return (
            f"estimated readout time is {1e3 * abs(self.estimated):.1f} ms{reverse}, but "
            f"{1e3 * self.given:.1f} ms was given; a wrong value distorts the map"
        )

    def refuse(self) -> None:
        """Raise ValueError where it differs: a map with it is bent, by more than it knows."""
        if self.differs:
            raise ValueError(f"{self.message}; -p readout_time:=0.0 estimates it")
