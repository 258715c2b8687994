"""Small planes, single frames, with and without a gyroscope."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.experiments.results import Claim, Context, Statement, Table
from benchmarks.honesty.estimating import believed, truth_of
from benchmarks.honesty.scores import Scores, percent, score_at
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import MakeMotions
from benchmarks.independent.gyroscopes import Imu
from benchmarks.independent.motions import rest, steady
from benchmarks.independent.scenes import Scene, SmallPlane
from benchmarks.inertial.recordings import (
    alone_and_aided,
    record,
)
from rs_localizer.core.arrays import BoolArray
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.localizer import Localizer

FEW = (7, 8, 12)  # inliers; the localizer takes no fewer than seven
US = "this project"
# As in the bench of small planes: a field of view of 45 degrees.
_NARROW = Camera(width=1000, height=1000, focal=1207.0)
_PLANES = ((0.2, 2.0), (0.6, 2.0), (1.0, 3.0))  # size and distance, m
_TILTS = (0.0, 30.0)  # deg
_TURN = 10.0  # deg per readout


Step = tuple[str, Table, list[Claim]]


def planes(context: Context) -> Step:
    rows: list[tuple[str | float, ...]] = []
    turned = math.radians(_TURN) / _NARROW.readout_time
    moving: MakeMotions = partial(steady, rate=turned, speed=0.1 / _NARROW.readout_time)
    every: dict[bool, list[Scores]] = {False: [], True: []}
    for size, distance in _PLANES:
        for tilt in _TILTS:
            for name, motion in (("rest", rest), (f"{_TURN:g}deg", moving)):
                scene = SmallPlane(size, distance, tilt)
                pair = single(_NARROW, motion, scene, context)
                for aided, scores in zip((False, True), pair, strict=True):
                    every[aided].append(scores)
                    label = f"{size:g}m at {distance:g}m/tilt {tilt:g}/{name}"
                    rows.append((f"{label}/{who(aided)}", *figures(scores)))
    hits = {aided: np.concatenate([s.inside("pose") for s in every[aided]]) for aided in every}
    medians = np.array([[s.median("orientation") for s in every[aided]] for aided in every])
    both = medians[:, np.isfinite(medians).all(axis=0)].mean(axis=1)
    errors = dict(zip(every, both.tolist(), strict=True))
    held = percent(hits[True])
    claims = [
        Statement(
            "inertial.planes-coverage",
            US,
            "Regions hold before small planes",
            "93 to 97 % of the poses of single frames",
        ).judged(
            f"{held:.1f} % (alone {percent(hits[False]):.1f} %)",
            93.0 <= held <= 97.0,
            "the pose mirrored on the plane and the typical speed are averaged, and a prior that "
            "allows for a camera that walks is wide for one that rests",
        ),
        Statement(
            "inertial.planes-error",
            US,
            "A gyroscope makes poses before small planes better",
            "smaller errors of the orientation, mean of the medians of what both localize",
        ).judged(
            f"{errors[True]:.3f} deg, alone {errors[False]:.3f} deg",
            errors[True] < errors[False],
        ),
    ]
    return "planes", Table(("condition", *COLUMNS), rows), claims


def single(
    camera: Camera, motion: MakeMotions, scene: Scene, context: Context, few: int | None = None
) -> tuple[Scores, Scores]:
    """Scores of single frames at 1 px: alone, and with the gyroscope less its bias."""
    count = max(4, context.trials // 20)
    recorded = record(camera, motion, scene, (count, 1), context.seed, replace(Imu(), bias=0.0))
    seen = believed(camera)
    localizer = Localizer(seen) if few is None else Localizer(seen, min_inliers=FEW[0])
    rng = np.random.default_rng(context.seed)
    results: tuple[list[Estimate | Failure], list[Estimate | Failure]] = ([], [])
    for frame in range(count):
        points, pixels = recorded.frames.seen(frame, 1.0)
        if few is not None:
            points, pixels = points[: 2 * few], pixels[: 2 * few]
            size = np.array([camera.width, camera.height]) - 1.0
            pixels[few:] = rng.uniform(0.0, size, pixels[few:].shape)  # as many wrong matches
        pair = alone_and_aided(recorded, localizer, frame, points, pixels)
        for kept, result in zip(results, pair, strict=True):
            kept.append(result)
    truths = [truth_of(recorded.frames.middle, frame) for frame in range(count)]
    alone, aided = (
        Scores(
            [
                score_at(result, 0.0, camera.readout_time, truth, frame)
                for frame, (result, truth) in enumerate(zip(kept, truths, strict=True))
            ]
        )
        for kept in results
    )
    return alone, aided


def who(aided: bool) -> str:
    return "gyroscope" if aided else "alone"


def right(scores: Scores) -> BoolArray:
    right: BoolArray = scores.of("orientation") < 1.0
    return right


COLUMNS = (
    "frames", "localized", "pose in", "twist in", "deg", "deg_95", "mm", "deg/s", "m/s", "reasons"
)  # fmt: skip


def figures(scores: Scores) -> tuple[str | float, ...]:
    errors = scores.of("orientation")[scores.localized]
    return (
        len(scores),
        percent(scores.localized),
        percent(scores.inside("pose")),
        percent(scores.inside("twist")),
        scores.median("orientation"),
        float(np.quantile(errors, 0.95)) if len(errors) else math.nan,
        1e3 * scores.median("position"),
        scores.median("angular"),
        scores.median("linear"),
        scores.reasons(),
    )
