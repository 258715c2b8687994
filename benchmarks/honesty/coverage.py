"""Do 95 % regions hold 95 %? Noise x motion x scene x tracking, at the stamp and at mid-frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

from benchmarks.honesty.estimating import (
    Found,
    believed,
    estimate,
    frames_of,
    scored,
)
from benchmarks.honesty.scores import percent
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import MakeMotions
from benchmarks.independent.motions import hand, rest, sudden_stop, vibration
from benchmarks.independent.scenes import Rich, Scene, SmallPlane, Wall
from rs_localizer.config import LocalizerConfig
from rs_localizer.localizer import Localizer

NOISES = (0.05, 0.1, 0.3, 1.0, 3.0)  # px
MOTIONS: dict[str, MakeMotions] = {
    "rest": rest,
    "hand": hand,
    "drone": partial(vibration, degrees=0.1, hertz=20.0),
    # Within the second of the five counted frames, so that what follows it is seen as well.
    "stop": partial(sudden_stop, earliest=0.0, latest=0.03),
}
SCENES: dict[str, Scene] = {"rich": Rich(), "wall": Wall(), "small-plane": SmallPlane()}


@dataclass(frozen=True, slots=True)
class Condition:
    """One point of the grid."""

    motion: str
    scene: str
    noise: float
    tracking: bool

    @property
    def name(self) -> str:
        followed = "tracked" if self.tracking else "single"
        return f"{self.motion}/{self.scene}/{self.noise:g}px/{followed}"


def conditions() -> Sequence[Condition]:
    """Those of one motion and scene one after the other: they share their frames."""
    grid = product(MOTIONS, SCENES, NOISES, (False, True))
    return [Condition(*point) for point in grid]


def measure(condition: Condition, frames: int, seed: int) -> Found:
    """The scores of a condition."""
    motion, scene = MOTIONS[condition.motion], SCENES[condition.scene]
    seen = frames_of(Camera(), motion, scene, frames, seed)
    camera = believed(seen.camera)
    # As users are told: the final inliers may miss by twice the threshold, 3.5 deviations have to.
    threshold = max(LocalizerConfig().inlier_threshold, 2.0 * condition.noise)
    localizer = Localizer(camera, inlier_threshold=threshold)
    results = estimate(seen, localizer, condition.noise, condition.tracking)
    return scored(seen, results, camera)


COLUMNS = (
    "condition", "frames", "pose@stamp", "pose@mid", "twist@stamp", "twist@mid",
    "over_5_sigma", "deg@stamp", "deg@mid", "mm@stamp", "mm@mid", "deg/s@mid", "m/s@mid",
    "refused", "reasons",
)  # fmt: skip


def row(name: str, found: Found) -> tuple[str | float | int, ...]:
    """Shares in %, medians of the errors."""
    stamp, middle = found.stamp, found.middle
    return (
        name,
        len(middle),
        *(percent(scores.inside("pose")) for scores in (stamp, middle)),
        *(percent(scores.inside("twist")) for scores in (stamp, middle)),
        max(percent(scores.far_off()) for scores in (stamp, middle)),
        *(scores.median("orientation") for scores in (stamp, middle)),
        *(1e3 * scores.median("position") for scores in (stamp, middle)),
        middle.median("angular"),
        middle.median("linear"),
        100.0 * middle.refused,
        middle.reasons(),
    )
