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

from benchmarks.frames.judged import REGION
from benchmarks.honesty.estimating import believed, estimate, frames_of, scored
from benchmarks.honesty.scores import Scores, percent
from benchmarks.independent.cameras import Camera
from benchmarks.independent.motions import hand
from benchmarks.independent.scenes import Board
from rs_localizer.config import LocalizerConfig
from rs_localizer.localizer import Localizer

_NOISES = (0.1, 0.5)  # px
_READOUTS = (0.0, 0.005, 0.011, 0.03)  # s
# Share of the distortion that the calibration lacks, and bend (m) that the map does not know.
_FAULTS = ((0.0, 0.0), (0.1, 0.0), (0.3, 0.0), (0.0, 2e-4), (0.0, 5e-4), (0.0, 2e-3), (0.1, 5e-4))
# 12 deg/s, as one who films a board.
_FILMING = partial(hand, slower=67.0 / 12.0)
# A user who sets a readout time for a global shutter.
_WRONG_READOUT = 0.02

COLUMNS = (
    "condition", "frames", "deg", "deg_p3p", "ratio", "deg_95", "deg_95_p3p", "ratio_95",
    "mm", "mm_p3p", "mm_95", "mm_95_p3p", "insignificant", "refused", "refused_p3p", "reasons",
)  # fmt: skip


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


def conditions() -> Sequence[Condition]:
    return [
        Condition(markers, *fault, noise, readout, told)
        for markers, fault, noise, readout in product((False, True), _FAULTS, _NOISES, _READOUTS)
        for told in (("unset", "set", "tracked") if readout > 0.0 else ("unset", "set"))
    ]


def row(condition: Condition, frames: int, seed: int) -> tuple[str | float | int, ...]:
    """Errors of the frames that both localize, at the middle row; shares in %."""
    tracking = condition.told == "tracked"
    ours = _scores(condition, LocalizerConfig().solver, tracking, frames, seed)
    theirs = _of_p3p(replace(condition, told="unset"), frames, seed)
    both = ours.localized & theirs.localized
    figures: list[float] = []
    for column, factor in (("orientation", 1.0), ("position", 1e3)):
        for quantile in (0.5, 0.95):
            pair = [factor * _quantile(one.of(column)[both], quantile) for one in (ours, theirs)]
            figures += [*pair, pair[0] / pair[1]] if column == "orientation" else pair
    return (
        condition.name,
        len(ours),
        *figures,
        percent(ours.of("moving")[ours.localized] < REGION),
        100.0 * ours.refused,
        100.0 * theirs.refused,
        ours.reasons(),
    )


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


def _quantile(values: np.ndarray, at: float) -> float:
    return float(np.quantile(values, at)) if len(values) else np.nan
