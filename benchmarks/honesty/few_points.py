"""Shaken cameras that see few points, some of them wrong, by one tone or a band of five."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import Frames, MakeMotions
from benchmarks.independent.motions import any_vibration, hand, rest
from benchmarks.independent.scenes import Rich
from rs_localizer.localizer import Localizer

MOTIONS: dict[str, MakeMotions] = {
    "0.1-0.3deg": partial(any_vibration, degrees=(0.1, 0.3), hertz=(20.0, 200.0)),
    "0.3-1deg": partial(any_vibration, degrees=(0.3, 1.0), hertz=(20.0, 200.0)),
    # Together 0.1 and 1 deg.
    "band-0.1deg": partial(any_vibration, degrees=(0.045, 0.045), hertz=(30.0, 150.0), tones=5),
    "band-1deg": partial(any_vibration, degrees=(0.45, 0.45), hertz=(30.0, 150.0), tones=5),
    "hand": hand,
    "rest": rest,
}
POINTS = (20, 30, 80)
WRONG = (0.0, 0.2, 0.5)
NOISES = (0.1, 0.5, 1.0)  # px
_MARGIN = 12.0  # px, of wrong points to the edge


@dataclass(frozen=True, slots=True)
class Condition:
    """One point of the grid; frames stand alone."""

    motion: str
    points: int
    wrong: float
    noise: float

    @property
    def name(self) -> str:
        return f"{self.motion}/{self.points}points/{self.wrong:.0%}wrong/{self.noise:g}px"


def conditions() -> Sequence[Condition]:
    return [Condition(*point) for point in product(MOTIONS, POINTS, WRONG, NOISES)]


def measure(condition: Condition, frames: int, seed: int) -> Found:
    """The scores of a condition."""
    seen = frames_of(Camera(), MOTIONS[condition.motion], Rich(), frames, seed, length=1)
    seen = _with_few(seen, condition, np.random.default_rng([seed, 1]))
    camera = believed(seen.camera)
    results = estimate(seen, Localizer(camera), condition.noise, tracking=False)
    return scored(seen, results, camera)


def _with_few(seen: Frames, condition: Condition, rng: np.random.Generator) -> Frames:
    """Frames of the first points only, the first of which are anywhere in the image."""
    rank = np.cumsum(seen.visible, axis=1)
    far = np.array([seen.camera.width, seen.camera.height]) - 1.0 - _MARGIN
    anywhere = rng.uniform(_MARGIN, far, seen.exact.shape)
    wrong = rank <= round(condition.wrong * condition.points)
    return replace(
        seen,
        visible=seen.visible & (rank <= condition.points),
        exact=np.where(wrong[..., None], anywhere, seen.exact),
    )
