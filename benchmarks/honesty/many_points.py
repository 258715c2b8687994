"""Frames of hundreds and thousands of points, where small mistakes of an estimator show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from benchmarks.honesty.coverage import MOTIONS
from benchmarks.honesty.estimating import (
    Found,
    believed,
    estimate,
    frames_of,
    scored,
)
from benchmarks.independent.cameras import Camera
from benchmarks.independent.scenes import Rich, Scene, SmallPlane, Wall
from rs_localizer.localizer import Localizer

POINTS = (300, 1000, 3000, 10_000)
NOISES = (0.1, 1.0)  # px


@dataclass(frozen=True, slots=True)
class Condition:
    """One point of the grid; frames stand alone."""

    motion: str
    scene: str
    points: int
    noise: float

    @property
    def name(self) -> str:
        return f"{self.motion}/{self.scene}/{self.points}points/{self.noise:g}px"


def conditions() -> Sequence[Condition]:
    """Those of one motion, scene and number one after the other: they share their frames."""
    grid = product(("rest", "hand"), ("rich", "wall", "small-plane"), POINTS, NOISES)
    return [Condition(*point) for point in grid]


def measure(condition: Condition, frames: int, seed: int) -> Found:
    """The scores of a condition."""
    count = condition.points
    scenes: dict[str, Scene] = {
        "rich": Rich(count), "wall": Wall(count), "small-plane": SmallPlane(points=count)
    }  # fmt: skip
    scene = scenes[condition.scene]
    seen = frames_of(Camera(), MOTIONS[condition.motion], scene, frames, seed, length=1)
    camera = believed(seen.camera)
    results = estimate(seen, Localizer(camera), condition.noise, tracking=False)
    return scored(seen, results, camera)
