# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Never worse than P3P: default against a global shutter, frame by frame, where maps and lenses
are a little off and the readout time is short, zero or not known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product

import numpy as np

from benchmarks.experiments.uncertainty import IntArray, Interval, bootstrap
from benchmarks.frames.judged import REGION
from benchmarks.honesty.estimating import believed, estimate, frames_of, scored
from benchmarks.honesty.scores import Scores, percent
from benchmarks.independent.cameras import Camera
from benchmarks.independent.motions import hand
from benchmarks.independent.scenes import Board
from rs_localizer.config import LocalizerConfig
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.localizer import Localizer

NOISES = (0.1, 0.5)  # px
READOUTS = (0.0, 0.005, 0.011, 0.03)  # s
# Share of the distortion that the calibration lacks, and bend (m) that the map does not know.
FAULTS = ((0.0, 0.0), (0.1, 0.0), (0.3, 0.0), (0.0, 2e-4), (0.0, 5e-4), (0.0, 2e-3), (0.1, 5e-4))
# 12 deg/s, as one who films a board.
_SLOWER = 67.0 / 12.0
# A user who sets a readout time for a global shutter.
_WRONG_READOUT = 0.02
MOST_RATIO = 1.1


@dataclass(frozen=True, slots=True)
class Condition:
    """A target, what is wrong with it and the lens, and what the user says of the shutter.

    ``told``: ``unset`` (the readout time is 0), ``set`` (single frames) or ``tracked``. A global
    shutter (readout 0) that is ``set`` has a wrong readout time of 20 ms.
    """

    markers: bool
    distortion_off: float
    bend: float
    noise: float
    readout: float
    told: str

    @property
    def name(self) -> str:
        target = "markers" if self.markers else "board"
        faults = f"lens {100 * self.distortion_off:g}% bend {1e3 * self.bend:g}mm"
        return f"{target}/{faults}/{self.noise:g}px/{1e3 * self.readout:g}ms/{self.told}"


@dataclass(frozen=True, slots=True)
class Pair:
    """Both on the same frames, at the middle row."""

    ours: Scores
    p3p: Scores

    @property
    def both(self) -> BoolArray:
        """Frames (n,) that both localize."""
        both: BoolArray = self.ours.localized & self.p3p.localized
        return both

    def ratio(
        self, quantile: float, column: str = "orientation", confidence: float = 0.95
    ) -> Interval:
        """Quantile of our errors in units of P3P's, of the frames that both localize."""
        ours, theirs = (scores.of(column)[self.both] for scores in (self.ours, self.p3p))

        def of(chosen: IntArray) -> float:
            return _quantile(ours[chosen], quantile) / _quantile(theirs[chosen], quantile)

        return bootstrap(of, len(ours), self.ours.recordings[self.both], confidence)

    @property
    def insignificant(self) -> BoolArray:
        """Of our localized frames (k,), those whose velocities' 95 % region contains zero."""
        within: BoolArray = self.ours.of("moving")[self.ours.localized] < REGION
        return within


def conditions() -> Sequence[Condition]:
    grid = product((False, True), FAULTS, NOISES, READOUTS)
    return [
        Condition(markers, *fault, noise, readout, told)
        for markers, fault, noise, readout in grid
        for told in (("unset", "set", "tracked") if readout > 0.0 else ("unset", "set"))
    ]


def measure(condition: Condition, frames: int, seed: int) -> Pair:
    """Both methods on the frames of a condition."""
    default = LocalizerConfig().solver
    tracking = condition.told == "tracked"
    ours = _scores(condition, default, tracking, frames, seed)
    return Pair(ours, _of_p3p(replace(condition, told="unset"), frames, seed))


@lru_cache(maxsize=1)
def _of_p3p(condition: Condition, frames: int, seed: int) -> Scores:
    """Which does not care what it is told of the readout time."""
    return _scores(condition, "p3p", False, frames, seed)


def _scores(condition: Condition, solver: str, tracking: bool, frames: int, seed: int) -> Scores:
    true = Camera(readout_time=condition.readout)
    scene = Board(condition.markers, condition.bend)
    seen = frames_of(true, _FILMING, scene, frames, seed)
    set_to = 0.0 if condition.told == "unset" else condition.readout or _WRONG_READOUT
    camera = believed(true, set_to, condition.distortion_off)
    results = estimate(seen, Localizer(camera, solver=solver), condition.noise, tracking)
    return scored(seen, results, camera).middle


_FILMING = partial(hand, slower=_SLOWER)

COLUMNS = (
    "condition", "frames", "deg", "deg_p3p", "ratio", "deg_95", "deg_95_p3p", "ratio_95",
    "mm", "mm_p3p", "mm_95", "mm_95_p3p", "insignificant", "refused", "refused_p3p", "reasons",
)  # fmt: skip


def row(name: str, pair: Pair) -> tuple[str | float | int, ...]:
    both = pair.both
    figures: list[float] = []
    for column, factor in (("orientation", 1.0), ("position", 1e3)):
        errors = [factor * scores.of(column)[both] for scores in (pair.ours, pair.p3p)]
        for quantile in (0.5, 0.95):
            ours, theirs = (_quantile(each, quantile) for each in errors)
            figures += [ours, theirs, ours / theirs] if column == "orientation" else [ours, theirs]
    return (
        name,
        len(pair.ours),
        *figures,
        percent(pair.insignificant),
        100.0 * pair.ours.refused,
        100.0 * pair.p3p.refused,
        pair.ours.reasons(),
    )


def _quantile(values: Array, at: float) -> float:
    # Of so few values sorting is ten times faster than NumPy's own quantile.
    return float(np.sort(values)[round(at * (len(values) - 1))]) if len(values) else np.nan
