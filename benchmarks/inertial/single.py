# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Single frames, with and without a gyroscope."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from benchmarks.experiments.results import Claim, Context, Table
from benchmarks.honesty.estimating import believed, truth_of
from benchmarks.honesty.scores import Scores, percent, score_at
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import MakeMotions
from benchmarks.independent.gyroscopes import Imu
from benchmarks.independent.scenes import Scene
from benchmarks.inertial.recordings import alone_and_aided, record
from rs_localizer.core.arrays import BoolArray
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.localizer import Localizer

FEW = (7, 8, 12)  # inliers; the localizer takes no fewer than seven
US = "this project"


Step = tuple[str, Table, list[Claim]]


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
