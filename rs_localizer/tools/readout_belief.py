# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""When a readout time is believed: deviations, parts, direction and stamps, in one place.

By :class:`Evidence` of a calibration, by :class:`ShutterFit` of a map whose shutter nobody knows,
and by :class:`ReadoutCheck` where one was given.
"""

from __future__ import annotations

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


# Parts that differ by this share of the value beyond chance, and by more than a value may be off:
# the camera may turn its picture.
_STABILISED = 0.1
_HALVES_SIGMAS = 3.0
# A readout time is determined to this part of the interval between images, 1.7 ms at 30 Hz: by the
# estimate itself a slow motion, which makes it too long, would make it better known. Nor do slow
# cameras have slow sensors.
_DETERMINED_SHARE, _LONGEST_INTERVAL = 0.05, 1.0 / 30.0
# Fewest parts that have to determine it by themselves, or length (s) that the recording has to
# have.
_LEAST_TELLING, _LONG = 3, 9.0
# A global shutter has 0 within this many deviations, and these within this (s): the fastest rolling
# shutters take 4 ms.
_GLOBAL_SIGMAS, _GLOBAL = 3.0, 2e-3
# Images that were exposed so far (s rms) beside their stamps have stamps that no camera gave.
_BESIDE = 1e-3
# Readouts cannot take longer than this part of the interval between images.
_LONGEST = 1.05


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Findings of a recording on a readout time."""

    readout_time: float  # s; negative: against the scan direction that was given
    deviation: float  # s, with what blocks and halves disagree in, and doubts of the stamps
    blocks: tuple[Block, ...]
    halves: tuple[Block, ...]
    inflation: float  # of the deviation, because the blocks disagree; 1: they do not
    stamps: Stamps
    own_stamps: bool  # the images' own, not those of a rate
    jitter: float  # s rms, by how much images were exposed beside their stamps; 0: they were not
    seconds: float  # how long the images with a pose last
    turned: bool  # whether rows rotate otherwise than images

    @property
    def limit(self) -> float:
        """Deviation (s) from which on a readout time is not determined."""
        return _DETERMINED_SHARE * min(self.stamps.interval, _LONGEST_INTERVAL)

    @property
    def telling(self) -> int:
        """How many blocks determine it by themselves."""
        return sum(block.deviation < self.limit for block in self.blocks)

    @property
    def determined(self) -> bool:
        """True where the motion determines the readout time, and parts can speak against it."""
        long_enough = self.telling >= _LEAST_TELLING or self.seconds >= _LONG
        return self.deviation < self.limit and long_enough

    @property
    def near_zero(self) -> bool:
        """True where 0 lies within the error."""
        return abs(self.readout_time) < _GLOBAL_SIGMAS * self.deviation

    @property
    def global_shutter(self) -> bool:
        """True where nothing else than a global shutter is left."""
        sure = _GLOBAL_SIGMAS * self.deviation < _GLOBAL and self.inflation == 1.0
        return self.determined and self.near_zero and sure and self.own_stamps

    @property
    def sense(self) -> float:
        """The sign by which readout times of parts are those along the direction that is told."""
        return 1.0 if self.global_shutter else math.copysign(1.0, self.readout_time)

    @property
    def stabilised(self) -> bool:
        """True where the parts disagree as those of a camera that turns its picture do."""
        least = max(_STABILISED * abs(self.readout_time), self.limit)
        apart, noise = apart_of(self.halves)
        by_halves = apart > max(_HALVES_SIGMAS * noise, 2.0 * least)
        values = [block.readout_time for block in self.blocks]
        scatter = np.std(values, ddof=1) if len(values) > 1 else 0.0
        return bool((self.inflation > 1.0 and scatter > least) or by_halves)

    @property
    def processed(self) -> str:
        """Why the film is hardly what the camera saw, one sentence; '': nothing says so."""
        why = []
        if self.stabilised:
            parts = ", ".join(f"{1e3 * self.sense * one.readout_time:.2f}" for one in self.blocks)
            why.append(f"parts of the recording disagree ({parts} ms)")
        if self.jitter > _BESIDE:
            why.append(f"exposures are {1e3 * self.jitter:.1f} ms rms off their stamps")
        if self.turned:
            why.append("rows rotate otherwise than images")
        return (
            f"{' and '.join(why)}: is image stabilization on, or was the video processed? Record "
            "with the camera's own time stamps, without losing images or re-encoding the video"
            if why
            else ""
        )

    @property
    def disbelief(self) -> str:
        """One line with the figure when the readout time is not determined; or ''."""
        interval = 1e3 * self.stamps.interval
        slowest = abs(self.readout_time) + _GLOBAL_SIGMAS * self.deviation
        if self.processed:
            why = f"; {self.processed}"
        elif abs(self.readout_time) > _LONGEST * self.stamps.interval:
            why = f" is longer than {interval:.1f} ms between images: is the frame rate right?"
        elif not self.determined:
            why = (
                f" (limit {1e3 * self.limit:.1f} ms; {self.telling} of {len(self.blocks)} parts of "
                f"the {self.seconds:.1f} s determine it on their own, three must, or 9 s): move "
                "the camera faster, rotate it about all axes, and for longer"
            )
        elif not (self.near_zero or self.own_stamps) and slowest < _GLOBAL:
            why = "; no rolling shutter is that fast: was the video stabilized or processed?"
        elif self.near_zero and not self.global_shutter:
            why = (
                "; that is no proof of a global shutter: three deviations are more than 2 ms, its "
                "parts differ, or the stamps are those of a video that was processed"
            )
        else:
            return ""
        value = 1e3 * self.sense * self.readout_time
        return f"not observable: {value:.1f} +- {1e3 * self.deviation:.1f} ms{why}"


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
    def possible(self) -> bool:
        """True where a camera can read an image out so slowly."""
        return self.readout_time < self.interval

    @property
    def visible(self) -> bool:
        """True where the images show a rolling shutter."""
        significant = self.readout_time > _SIGNIFICANT * self.deviation
        return significant and self.chance < _CHANCE and self.possible


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
