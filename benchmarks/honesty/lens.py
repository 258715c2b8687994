"""A calibration that lacks part of the lens's distortion, before rich scenes and a wall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from benchmarks.honesty.estimating import (
    LENGTH,
    Found,
    believed,
    estimate,
    frames_of,
    scored,
)
from benchmarks.independent.cameras import Camera
from benchmarks.independent.motions import hand
from benchmarks.independent.scenes import Rich, Scene, Wall
from rs_localizer.localizer import Localizer

SCENES: dict[str, Scene] = {"rich": Rich(), "wall": Wall()}
LACKING = (0.0, 0.01, 0.03, 0.1, 0.3)  # share of the distortion
NOISES = (0.1, 0.3, 1.0)  # px
# Frames of a recording, of which the last five count; None: they stand alone.
TOLD = {"single": None, "tracked": LENGTH, "later": 25}


@dataclass(frozen=True, slots=True)
class Condition:
    """One point of the grid; ``later`` is tracked for 20 frames before those that count."""

    scene: str
    lacking: float
    noise: float
    told: str

    @property
    def name(self) -> str:
        return f"{self.scene}/{self.lacking:.0%}/{self.noise:g}px/{self.told}"


def conditions() -> Sequence[Condition]:
    return [Condition(*point) for point in product(SCENES, LACKING, NOISES, TOLD)]


def measure(condition: Condition, frames: int, seed: int) -> Found:
    """The scores of a condition."""
    length = TOLD[condition.told]
    seen = frames_of(Camera(), hand, SCENES[condition.scene], frames, seed, length or LENGTH)
    camera = believed(seen.camera, distortion_off=condition.lacking)
    results = estimate(seen, Localizer(camera), condition.noise, length is not None)
    return scored(seen, results, camera)
