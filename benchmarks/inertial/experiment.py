# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The experiment: with a gyroscope and without, on the same frames."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.experiments.results import Claim, Context, Result, Statement, Table
from benchmarks.honesty.estimating import believed, truth_of
from benchmarks.honesty.scores import Scores, percent, score_at
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import MakeMotions
from benchmarks.independent.gyroscopes import Imu
from benchmarks.independent.motions import hand, shaken_hand
from benchmarks.independent.scenes import Rich, Scene
from benchmarks.inertial.recordings import alone_and_aided, follow, follow_both, record
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


_SHAKING = ((0.3, 60.0), (0.1, 120.0))  # degrees, hertz
_NOISES = (0.3, 1.0)  # px
_SECOND, _SETTLED, _TEN_SECONDS = 30, 90, 300  # frames
_OFFSET = 0.005  # s
_MOST_COST = 1.15


def run(context: Context) -> Result:
    """The experiment."""
    claims: list[Claim] = []
    tables: dict[str, Table] = {}
    steps = [_vibration, _offsets, _few_points, _cost]
    for step in context.track(steps, len(steps)):
        name, table, judged = step(context)
        tables[f"inertial_{name}"] = table
        claims += judged
    return Result(
        "With a gyroscope",
        "Frames of the simulator that shares no code with the estimator (30 Hz, 640x480, 30 ms "
        "readout) with a gyroscope of 400 Hz, 0.01 deg/s/sqrt(Hz) and a bias of 0.5 deg/s, whose "
        "bias and time offset the tracker has to find. Vibration: 0.3 deg at 60 Hz and 0.1 deg at "
        "120 Hz on top of a hand's motion, after the first three seconds. Few points: "
        "single frames, with the gyroscope less its bias, which is known to 0.05 deg/s and 50 us. "
        "Shares in %, medians of the errors.",
        claims,
        tables,
    )


def _vibration(context: Context) -> Step:
    length = 6 * _SECOND
    count = max(1, context.trials // _SECOND // 5)
    shaken: MakeMotions = partial(shaken_hand, shaking=_SHAKING)
    rows: list[tuple[str | float, ...]] = []
    claims: list[Claim] = []
    for noise in _NOISES:
        found: dict[str, Scores] = {}
        for name, motion in (("hand", hand), ("shaken", shaken)):
            recorded = record(Camera(), motion, Rich(), (count, length), context.seed)
            for aided in (False, True):
                followed = follow(recorded, noise, aided, _SETTLED)
                label = f"{name}/{'gyroscope' if aided else 'alone'}"
                found[label], found[f"{label}/first"] = followed.scores, followed.first
                rows.append((f"{label}/{noise:g}px", *figures(followed.scores)))
                rows.append((f"{label}/{noise:g}px/first row", *figures(followed.first)))
        claims += _judge_vibration(noise, found)
    return "vibration", Table(("condition", *COLUMNS), rows), claims


def _judge_vibration(noise: float, found: dict[str, Scores]) -> list[Claim]:
    shaken, still = found["shaken/gyroscope"], found["hand/alone"]
    ratio = shaken.median("orientation") / still.median("orientation")
    localized = percent(shaken.localized)
    rates = [shaken.median("angular"), found["shaken/gyroscope/first"].median("angular")]
    alone = found["shaken/alone"]
    return [
        Statement(
            f"inertial.vibration-{noise:g}px-localized",
            US,
            f"Vibration leaves the frames localized ({noise:g} px)",
            "at least 97 %",
        ).judged(f"{localized:.1f} % (alone {percent(alone.localized):.1f} %)", localized >= 97.0),
        Statement(
            f"inertial.vibration-{noise:g}px-orientation",
            US,
            f"Vibration hardly costs orientation ({noise:g} px)",
            "at most 1.3 times the error of the camera alone without vibration",
        ).judged(
            f"{ratio:.2f} times {still.median('orientation'):.4f} deg (alone "
            f"{alone.median('orientation') / still.median('orientation'):.2f} times)",
            ratio <= 1.3,
        ),
        Statement(
            f"inertial.vibration-{noise:g}px-rate",
            US,
            f"The angular velocity is that of the vibration ({noise:g} px)",
            "at most 3 deg/s, at mid-frame and at the first row",
        ).judged(
            f"{rates[0]:.2f} and {rates[1]:.2f} deg/s (alone {alone.median('angular'):.1f} and "
            f"{found['shaken/alone/first'].median('angular'):.1f} deg/s)",
            max(rates) <= 3.0,
        ),
        Statement(
            f"inertial.vibration-{noise:g}px-coverage",
            US,
            f"Regions hold under vibration ({noise:g} px)",
            "at least 93 % of poses and twists",
        ).judged(
            f"poses {percent(shaken.inside('pose')):.1f} %, twists "
            f"{percent(shaken.inside('twist')):.1f} %",
            min(percent(shaken.inside(part)) for part in ("pose", "twist")) >= 93.0,
        ),
    ]


def _offsets(context: Context) -> Step:
    count = max(1, context.trials // _TEN_SECONDS)
    rows: list[tuple[str | float, ...]] = []
    worst: dict[str, float] = {}
    shaken = {
        " and ".join(f"{hertz:g} Hz" for _, hertz in shaking): partial(shaken_hand, shaking=shaking)
        for shaking in (_SHAKING, *(((0.3, hertz),) for hertz in (60.0, 61.3, 120.0)))
    }
    motions: dict[str, MakeMotions] = {"hand": hand, **shaken}
    for name, motion in motions.items():
        imu = replace(Imu(), offset=_OFFSET)
        recorded = record(Camera(), motion, Rich(), (count, _TEN_SECONDS), context.seed, imu)
        followed = follow(recorded, 1.0, True, _SECOND)
        worst[name] = 1e3 * float(np.abs(np.array(followed.time_offsets) - _OFFSET).max())
        rows.append((name, worst[name], *figures(followed.scores)))
    claim = Statement(
        "inertial.offset",
        US,
        "Stamps that are 5 ms early are found out within 10 s, in no other period of a vibration",
        "to 0.5 ms in every recording, with and without vibration",
    ).judged(
        ", ".join(f"{name} {off:.3f} ms" for name, off in worst.items()), max(worst.values()) <= 0.5
    )
    return "offset", Table(("motion", "ms off", *COLUMNS), rows), [claim]


def _few_points(context: Context) -> Step:
    rows: list[tuple[str | float, ...]] = []
    claims: list[Claim] = []
    for few in FEW:
        alone, aided = single(Camera(), hand, Rich(), context, few)
        rows += [
            (f"{few} inliers/{who(which)}", *figures(scores))
            for which, scores in ((False, alone), (True, aided))
        ]
        share = percent(right(aided))
        claims.append(
            Statement(
                f"inertial.few-{few}",
                US,
                f"{few} right matches among as many wrong ones are enough for the solver that is "
                "there (r6p_vcwt on compensated bearings)",
                "at least 95 % of the frames within 1 deg",
            ).judged(
                f"{share:.0f} % (alone {percent(right(alone)):.0f} %)",
                share >= 95.0,
                "a pose of so few points may be refused, as it should be, whoever proposes it",
            )
        )
    return "few_points", Table(("condition", *COLUMNS), rows), claims


def _cost(context: Context) -> Step:
    count = max(1, context.trials // 100)
    recorded = record(Camera(), hand, Rich(), (count, 2 * _SECOND), context.seed)
    follow(recorded, 1.0, True, _SECOND)  # compiles
    alone, aided = follow_both(recorded, 1.0, _SECOND)
    ratio = float(np.median(aided.seconds) / np.median(alone.seconds))
    rows = [
        (who(which), 1e3 * float(np.median(f.seconds)), *figures(f.scores))
        for which, f in ((False, alone), (True, aided))
    ]
    claim = Statement(
        "inertial.cost",
        US,
        "A gyroscope costs little time",
        f"a tracked frame of 80 points takes at most {_MOST_COST:g} times as long",
    ).judged(
        f"{ratio:.2f} times",
        ratio <= _MOST_COST,
        "what a gyroscope costs hardly depends on the number of points, and these are few",
    )
    return "cost", Table(("condition", "ms", *COLUMNS), rows), [claim]
