"""Small planes far away, whose points cannot tell a slow motion from rest, at 1 px."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from benchmarks.honesty.estimating import (
    Found,
    believed,
    estimate,
    frames_of,
    scored,
)
from benchmarks.honesty.scores import percent
from benchmarks.independent.cameras import Camera
from benchmarks.independent.motions import steady
from benchmarks.independent.scenes import SmallPlane
from rs_localizer.localizer import Localizer

SIZES = (0.2, 0.6, 1.0)  # m
DISTANCES = (2.0, 3.0)  # m
TILTS = (0.0, 30.0, 60.0)  # deg
TURNS = (0.0, 3.0, 10.0)  # deg per readout
NOISE = 1.0  # px
GROSS = 10.0  # deg
_METRES_PER_DEGREE = 0.01
# A field of view of 45 degrees, as in the paper's experiments: the smallest plane has 80 px.
_CAMERA = Camera(width=1000, height=1000, focal=1207.0)


@dataclass(frozen=True, slots=True)
class Condition:
    """A plane and how fast the camera moves; every frame is on its own."""

    size: float
    distance: float
    tilt: float
    turn: float

    @property
    def name(self) -> str:
        plane = f"{self.size:g}m at {self.distance:g}m"
        return f"{plane}/tilt {self.tilt:g}/{self.turn:g}deg"


def conditions() -> Sequence[Condition]:
    return [Condition(*point) for point in product(SIZES, DISTANCES, TILTS, TURNS)]


def measure(condition: Condition, frames: int, seed: int) -> Found:
    """The scores of a condition."""
    plane = SmallPlane(condition.size, condition.distance, condition.tilt)
    true = _CAMERA
    turning = partial(
        steady,
        rate=math.radians(condition.turn) / true.readout_time,
        speed=_METRES_PER_DEGREE * condition.turn / true.readout_time,
    )
    seen = frames_of(true, turning, plane, frames, seed, length=1)
    camera = believed(true)
    return scored(seen, estimate(seen, Localizer(camera), NOISE, False), camera)


COLUMNS = (
    "condition", "frames", "pose@stamp",
    "pose@mid", "twist@mid", "over_5_sigma", "gross", "deg", "deg_95",
    "refused", "reasons",
)  # fmt: skip


def row(name: str, found: Found) -> tuple[str | float | int, ...]:
    """Shares in %; gross errors of the frames with a pose."""
    scores = found.middle
    errors = scores.of("orientation")[scores.localized]
    return (
        name,
        len(scores),
        percent(found.stamp.inside("pose")),
        percent(scores.inside("pose")),
        percent(scores.inside("twist")),
        percent(scores.far_off()),
        percent(errors > GROSS),
        scores.median("orientation"),
        float(np.quantile(errors, 0.95)) if len(errors) else np.nan,
        100.0 * scores.refused,
        scores.reasons(),
    )
