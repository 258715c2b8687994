"""The experiment: with a gyroscope and without, on the same frames."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from rs_localizer.core.arrays import BoolArray
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.lab.experiments.honesty.estimating import believed, truth_of
from rs_localizer.lab.experiments.honesty.scores import Scores, percent, score_at
from rs_localizer.lab.experiments.inertial.recordings import (
    Followed,
    Recorded,
    alone_and_aided,
    follow,
    record,
)
from rs_localizer.lab.experiments.results import Claim, Context, Result, Statement, Table
from rs_localizer.lab.independent.cameras import Camera
from rs_localizer.lab.independent.frames import MakeMotions
from rs_localizer.lab.independent.gyroscopes import Imu
from rs_localizer.lab.independent.motions import hand, rest, shaken_hand, steady
from rs_localizer.lab.independent.scenes import Rich, Scene, SmallPlane
from rs_localizer.localizer import Localizer

_US = "this project"
_SHAKING = ((0.3, 60.0), (0.1, 120.0))  # degrees, hertz
_NOISES = (0.3, 1.0)  # px
_SECOND, _SETTLED, _TEN_SECONDS = 30, 90, 300  # frames
_OFFSET = 0.005  # s
# As in the bench of small planes: a field of view of 45 degrees.
_NARROW = Camera(width=1000, height=1000, focal=1207.0)
_PLANES = ((0.2, 2.0), (0.6, 2.0), (1.0, 3.0))  # size and distance, m
_TILTS = (0.0, 30.0)  # deg
_TURN = 10.0  # deg per readout
_FEW = (7, 8, 12)  # inliers; the localizer takes no fewer than seven
_MOST_COST = 1.15


def run(context: Context) -> Result:
    """The experiment."""
    claims: list[Claim] = []
    tables: dict[str, Table] = {}
    steps = [_vibration, _offsets, _planes, _few_points, _cost]
    for step in context.track(steps, len(steps)):
        name, table, judged = step(context)
        tables[f"inertial_{name}"] = table
        claims += judged
    return Result(
        "With a gyroscope",
        "Frames of the simulator that shares no code with the estimator (30 Hz, 640x480, 30 ms "
        "readout) with a gyroscope of 400 Hz, 0.01 deg/s/sqrt(Hz) and a bias of 0.5 deg/s, whose "
        "bias and time offset the tracker has to find. Vibration: 0.3 deg at 60 Hz and 0.1 deg at "
        "120 Hz on top of a hand's motion, after the first three seconds. Planes and few points: "
        "single frames, with the gyroscope less its bias, which is known to 0.05 deg/s and 50 us. "
        "Shares in %, medians of the errors.",
        claims,
        tables,
    )


_Step = tuple[str, Table, list[Claim]]


def _vibration(context: Context) -> _Step:
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
                scores = follow(recorded, noise, aided, _SETTLED).scores
                label = f"{name}/{'gyroscope' if aided else 'alone'}"
                found[label] = scores
                rows.append((f"{label}/{noise:g}px", *_figures(scores)))
        claims += _judge_vibration(noise, found)
    return "vibration", Table(("condition", *_COLUMNS), rows), claims


def _judge_vibration(noise: float, found: dict[str, Scores]) -> list[Claim]:
    shaken, still = found["shaken/gyroscope"], found["hand/alone"]
    ratio = shaken.median("orientation") / still.median("orientation")
    localized, angular = percent(shaken.localized), shaken.median("angular")
    alone = found["shaken/alone"]
    return [
        Statement(
            f"inertial.vibration-{noise:g}px-localized",
            _US,
            f"Vibration leaves the frames localized ({noise:g} px)",
            "at least 97 %",
        ).judged(
            f"{localized:.1f} % (alone {percent(alone.localized):.1f} %)",
            localized >= 97.0,
        ),
        Statement(
            f"inertial.vibration-{noise:g}px-orientation",
            _US,
            f"Vibration hardly costs orientation ({noise:g} px)",
            "at most 1.3 times the error of the camera alone without vibration",
        ).judged(
            f"{ratio:.2f} times {still.median('orientation'):.4f} deg (alone "
            f"{alone.median('orientation') / still.median('orientation'):.2f} times)",
            ratio <= 1.3,
        ),
        Statement(
            f"inertial.vibration-{noise:g}px-rate",
            _US,
            f"The angular velocity is that of the vibration ({noise:g} px)",
            "at most 3 deg/s",
        ).judged(
            f"{angular:.2f} deg/s (alone {alone.median('angular'):.1f} deg/s)",
            angular <= 3.0,
        ),
        Statement(
            f"inertial.vibration-{noise:g}px-coverage",
            _US,
            f"Regions hold under vibration ({noise:g} px)",
            "at least 93 % of poses and twists",
        ).judged(
            f"poses {percent(shaken.inside('pose')):.1f} %, twists "
            f"{percent(shaken.inside('twist')):.1f} %",
            min(percent(shaken.inside(part)) for part in ("pose", "twist")) >= 93.0,
        ),
    ]


def _offsets(context: Context) -> _Step:
    count = max(1, context.trials // _TEN_SECONDS)
    imu = replace(Imu(), offset=_OFFSET)
    rows: list[tuple[str | float, ...]] = []
    worst = 0.0
    for name, motion in (("hand", hand), ("shaken", partial(shaken_hand, shaking=_SHAKING))):
        recorded = record(Camera(), motion, Rich(), (count, _TEN_SECONDS), context.seed, imu)
        followed = follow(recorded, 1.0, True, _SECOND)
        errors = 1e3 * (np.array(followed.time_offsets) - _OFFSET)
        worst = max(worst, float(np.abs(errors).max()))
        rows.append((name, float(np.abs(errors).max()), *_figures(followed.scores)))
    claim = Statement(
        "inertial.offset",
        _US,
        "Stamps that are 5 ms early are found out within 10 s",
        "to 0.5 ms in every recording, with and without vibration",
    ).judged(
        f"to {worst:.3f} ms",
        worst <= 0.5,
    )
    return "offset", Table(("motion", "ms off", *_COLUMNS), rows), [claim]


def _planes(context: Context) -> _Step:
    rows: list[tuple[str | float, ...]] = []
    turned = math.radians(_TURN) / _NARROW.readout_time
    moving: MakeMotions = partial(steady, rate=turned, speed=0.1 / _NARROW.readout_time)
    every: dict[bool, list[Scores]] = {False: [], True: []}
    for size, distance in _PLANES:
        for tilt in _TILTS:
            for name, motion in (("rest", rest), (f"{_TURN:g}deg", moving)):
                scene = SmallPlane(size, distance, tilt)
                pair = _single(_NARROW, motion, scene, context)
                for aided, scores in zip((False, True), pair, strict=True):
                    every[aided].append(scores)
                    label = f"{size:g}m at {distance:g}m/tilt {tilt:g}/{name}"
                    rows.append((f"{label}/{_who(aided)}", *_figures(scores)))
    hits = {aided: np.concatenate([s.inside("pose") for s in every[aided]]) for aided in every}
    errors = {
        aided: float(np.mean([s.median("orientation") for s in every[aided]])) for aided in every
    }
    held = percent(hits[True])
    claims = [
        Statement(
            "inertial.planes-coverage",
            _US,
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
            _US,
            "A gyroscope makes poses before small planes better",
            "smaller errors of the orientation, mean of the medians",
        ).judged(
            f"{errors[True]:.3f} deg, alone {errors[False]:.3f} deg",
            errors[True] < errors[False],
        ),
    ]
    return "planes", Table(("condition", *_COLUMNS), rows), claims


def _single(
    camera: Camera, motion: MakeMotions, scene: Scene, context: Context, few: int | None = None
) -> tuple[Scores, Scores]:
    """Scores of single frames at 1 px: alone, and with the gyroscope less its bias."""
    count = max(4, context.trials // 20)
    recorded = record(camera, motion, scene, (count, 1), context.seed, replace(Imu(), bias=0.0))
    seen = believed(camera)
    localizer = Localizer(seen) if few is None else Localizer(seen, min_inliers=_FEW[0])
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


def _few_points(context: Context) -> _Step:
    rows: list[tuple[str | float, ...]] = []
    claims: list[Claim] = []
    for few in _FEW:
        alone, aided = _single(Camera(), hand, Rich(), context, few)
        rows += [
            (f"{few} inliers/{_who(which)}", *_figures(scores))
            for which, scores in ((False, alone), (True, aided))
        ]
        share = percent(_right(aided))
        claims.append(
            Statement(
                f"inertial.few-{few}",
                _US,
                f"{few} right matches among as many wrong ones are enough for the solver that is "
                "there (r6p_vcwt on steadied bearings)",
                "at least 95 % of the frames within 1 deg",
            ).judged(
                f"{share:.0f} % (alone {percent(_right(alone)):.0f} %)",
                share >= 95.0,
                "a pose of so few points may be refused, as it should be, whoever proposes it",
            )
        )
    return "few_points", Table(("condition", *_COLUMNS), rows), claims


def _cost(context: Context) -> _Step:
    count = max(1, context.trials // 100)
    recorded = record(Camera(), hand, Rich(), (count, 2 * _SECOND), context.seed)
    alone, aided = _interleaved(recorded)
    ratio = float(np.median(aided.seconds) / np.median(alone.seconds))
    rows = [
        (_who(which), 1e3 * float(np.median(f.seconds)), *_figures(f.scores))
        for which, f in ((False, alone), (True, aided))
    ]
    claim = Statement(
        "inertial.cost",
        _US,
        "A gyroscope costs little time",
        f"a tracked frame of 80 points takes at most {_MOST_COST:g} times as long",
    ).judged(
        f"{ratio:.2f} times",
        ratio <= _MOST_COST,
        "integration, filter and steadied bearings are 0.5 ms beside a frame of 1.4 ms, whatever "
        "the number of points",
    )
    return "cost", Table(("condition", "ms", *_COLUMNS), rows), [claim]


def _interleaved(recorded: Recorded) -> tuple[Followed, Followed]:
    follow(recorded, 1.0, True, _SECOND)  # compiles
    return follow(recorded, 1.0, False, _SECOND), follow(recorded, 1.0, True, _SECOND)


def _who(aided: bool) -> str:
    return "gyroscope" if aided else "alone"


def _right(scores: Scores) -> BoolArray:
    right: BoolArray = scores.of("orientation") < 1.0
    return right


_COLUMNS = (
    "frames", "localized", "pose in", "twist in", "deg", "deg_95", "mm", "deg/s", "m/s", "reasons"
)  # fmt: skip


def _figures(scores: Scores) -> tuple[str | float, ...]:
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
