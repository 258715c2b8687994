"""Shaken by 0.1 to 1 deg at 5 to 200 Hz, without an IMU: regions hold, or frames are refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import product

from benchmarks.honesty.estimating import (
    Found,
    believed,
    estimate,
    frames_of,
    scored,
)
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import MakeMotions
from benchmarks.independent.motions import vibration
from benchmarks.independent.scenes import Rich
from rs_localizer.localizer import Localizer

DEGREES = (0.1, 0.3, 1.0)
HERTZ = (5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
NOISES = (0.1, 1.0)  # px


@dataclass(frozen=True, slots=True)
class Condition:
    """A shaking camera before a rich scene."""

    degrees: float
    hertz: float
    noise: float
    tracking: bool

    @property
    def name(self) -> str:
        followed = "tracked" if self.tracking else "single"
        return f"{self.degrees:g}deg/{self.hertz:g}Hz/{self.noise:g}px/{followed}"


def conditions() -> Sequence[Condition]:
    return [Condition(*point) for point in product(DEGREES, HERTZ, NOISES, (False, True))]


def measure(condition: Condition, frames: int, seed: int) -> Found:
    """The scores of a condition."""
    shaken = _shaken(condition.degrees, condition.hertz)
    seen = frames_of(Camera(), shaken, Rich(), frames, seed)
    camera = believed(seen.camera)
    results = estimate(seen, Localizer(camera), condition.noise, condition.tracking)
    return scored(seen, results, camera)


@lru_cache
def _shaken(degrees: float, hertz: float) -> MakeMotions:
    """The same object for the same figures: simulated frames are kept by it."""
    return partial(vibration, degrees=degrees, hertz=hertz)
