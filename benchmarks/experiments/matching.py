# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Keypoints in a large map: how fast from the message to the pose, and how well recognized."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np

from benchmarks.data import HAND_MOTION
from benchmarks.experiments.results import Claim, Context, Result, Statement, Table
from rs_localizer.config import Matching, NodeConfig
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import make_message
from rs_localizer.io.camera_info import Calibration
from rs_localizer.io.clouds import Keypoints, make_cloud
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.outputs import Localized
from rs_localizer.io.trajectories import read_tum
from rs_localizer.localizer import Localizer
from rs_localizer.matching import Matcher
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.tools.simulation.frames import SimulatedFrame, frame_stamps, simulate_frames
from rs_localizer.tools.simulation.scene import (
    keypoint_rows,
    random_descriptors,
    room,
    seen_descriptors,
)
from rs_localizer.tools.simulation.settings import FrameSettings
from rs_localizer.tools.simulation.true_motion import RecordedMotion, TrueMotion

_FRAMES = 12
_WRONG = 0.9
# Where samples are plenty, the search finds the right ones without scores, too.
_SAMPLES = 200
# Neither test removes wrong matches: the scores alone tell them from right ones.
_EVERYTHING = Matching(ratio=1.0, mutual=False)


def scores_claim(
    context: Context, camera: Camera, motion: TrueMotion, stamps: Sequence[int], points: Array
) -> Claim:
    """Frames nine tenths of whose keypoints show what is not in the map."""
    seen = FrameSettings(points=500, noise=0.7, outliers=_WRONG)
    frames = simulate_frames(
        camera, motion, points, seen, stamps_ns=list(stamps[:_FRAMES]), seed=context.seed
    )
    rng = np.random.default_rng(context.seed)
    landmarks = Map(points, None, random_descriptors(len(points), rng), "map")
    matcher = Matcher(landmarks)
    localizer = Localizer(camera, max_iterations=_SAMPLES)
    found = {"with": 0, "without": 0}
    count = 0
    for frame in islice(context.track(frames, _FRAMES), _FRAMES):
        keypoints = _keypoints(frame, landmarks, rng)
        matches = matcher.match(keypoints, _EVERYTHING)
        given = points[matches.landmarks], keypoints.pixels[matches.keypoints]
        found["with"] += bool(localizer.localize(*given, matches.scores))
        found["without"] += bool(localizer.localize(*given))
        count += 1
    return Statement(
        "matching.scores",
        "this project",
        f"where {_WRONG:.0%} of the keypoints show what is not in the map, the scores of their "
        "matches lead the search to the right ones",
        f"all frames localized with scores and {_SAMPLES} samples, fewer without",
    ).judged(
        f"{found['with']} and {found['without']} of {count}",
        found["with"] == count > found["without"],
    )


def _keypoints(frame: SimulatedFrame, landmarks: Map, rng: np.random.Generator) -> Keypoints:
    assert landmarks.descriptors is not None
    descriptors = seen_descriptors(landmarks.descriptors[frame.ids], rng)
    strangers = ~frame.inliers
    width = descriptors.shape[1]
    descriptors[strangers] = random_descriptors(int(strangers.sum()), rng, width)
    return Keypoints(frame.stamp_ns, frame.pixels, None, descriptors, None, 0)


_LANDMARKS = 100_000
_SEEN = FrameSettings(points=500, noise=0.5, outliers=0.3, rate=30.0)
_READOUT_TIME = 0.03
_K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
_FRAMES_PER_TRIAL = 0.03
_FEWEST, _MOST = 10, 100
# So many landmarks look the same where nothing is recognized by its looks alone.
_ALIKE = 50
_FLOATS = 128
# A pose this far off is no good frame (m).
_LOST = 0.05


@dataclass(slots=True)
class Run:
    """A way of matching, and what became of the frames."""

    name: str
    label: str
    landmarks: Map
    settings: Matching
    tracking: bool
    at_least: float = np.nan  # Hz
    first_by_id: bool = False
    seconds: list[float] = field(default_factory=list)  # of the clock
    cpu: list[float] = field(default_factory=list)  # s, of all threads
    localized: int = 0
    right: list[float] = field(default_factory=list)  # share of the inliers

    def localizer(self) -> FrameLocalizer:
        config = NodeConfig(
            readout_time=_READOUT_TIME, tracking=self.tracking, matching=self.settings
        )
        result = FrameLocalizer(config)
        K = tuple(_K.ravel().tolist())
        result.calibrate(Calibration("camera", 640, 480, K, (), "plumb_bob", (1, 1), None))
        result.use_map(self.landmarks)
        return result

    @property
    def milliseconds(self) -> tuple[float, float]:
        """Medians of the clock and of the CPU, after the first two frames."""
        return 1e3 * float(np.median(self.seconds[2:])), 1e3 * float(np.median(self.cpu[2:]))

    @property
    def rightness(self) -> float:
        """Share of the inliers that are right."""
        return float(np.mean(self.right)) if self.right else 0.0


def run(context: Context) -> Result:
    """The experiment."""
    wanted = int(np.clip(_FRAMES_PER_TRIAL * context.trials, _FEWEST, _MOST))
    motion = RecordedMotion(read_tum(HAND_MOTION))
    first, last = motion.intervals_ns[0]
    way = motion.state(first, np.linspace(0.0, (last - first) * 1e-9, 400)).positions
    rng = np.random.default_rng(context.seed)
    points = room(way, rng, count=_LANDMARKS)
    camera = Camera(640, 480, _K, readout_time=_READOUT_TIME)
    stamps = frame_stamps(motion, camera, _SEEN.rate)[:wanted]
    frames = simulate_frames(camera, motion, points, _SEEN, stamps_ns=stamps, seed=context.seed)
    runs = _runs(points, rng)
    _measure(runs, list(islice(frames, wanted)), context)
    return Result(
        "Matching",
        f"A room with {_LANDMARKS:,} landmarks, the first {wanted} frames of the recorded motion "
        f"of a hand at {_SEEN.rate:g} Hz, {_SEEN.points} keypoints each, {_SEEN.outliers:.0%} of "
        "them wrong; binary descriptors of 32 bytes in which a tenth of the bits differ from the "
        "map's. Times are medians from the message to the pose, matched and localized, on a "
        "machine that may have other things to do: of the clock, and of the CPU in all threads.",
        [
            *(_fast_enough(run) for run in runs if np.isfinite(run.at_least)),
            *_recognized(runs),
            scores_claim(context, camera, motion, stamps, points),
        ],
        {"matching": Table(_COLUMNS, [_row(run) for run in runs])},
        notes=[_text(runs)],
    )


_COLUMNS = ("method", "median_ms", "cpu_ms", "frames", "localized", "right_inliers")


def _runs(points: Any, rng: np.random.Generator) -> list[Run]:
    ids = rng.permutation(len(points)).astype(np.int64)
    bits = random_descriptors(len(points), rng)
    alike = random_descriptors(len(points) // _ALIKE, rng)[np.arange(len(points)) // _ALIKE]
    alike = np.ascontiguousarray(alike[rng.permutation(len(points))])
    floats = rng.normal(size=(len(points), _FLOATS)).astype(np.float32)
    binary, numbers = Map(points, ids, bits, "map"), Map(points, ids, floats, "map")
    similar = Map(points, ids, alike, "map")
    whole, predicted = (Matching(), False), (Matching(), True)
    return [
        Run("id", "by id", binary, Matching(by="id"), False, 100.0),
        Run("whole", "32 bytes, whole map", binary, *whole, 10.0),
        Run("predicted", "32 bytes, predicted", binary, *predicted, 30.0),
        Run("floats", f"{_FLOATS} floats, whole map", numbers, *whole),
        Run("floats_predicted", f"{_FLOATS} floats, predicted", numbers, *predicted),
        Run("alike", f"{_ALIKE} alike, whole map", similar, *whole, first_by_id=True),
        Run("alike_predicted", f"{_ALIKE} alike, predicted", similar, *predicted, first_by_id=True),
    ]


def _measure(runs: Sequence[Run], frames: Sequence[SimulatedFrame], context: Context) -> None:
    localizers = [run.localizer() for run in runs]
    localizers[0].warm_up()
    for index, frame in enumerate(context.track(frames, len(frames))):
        for run, localizer in zip(runs, localizers, strict=True):
            rows = keypoint_rows(frame, run.landmarks, np.random.default_rng([context.seed, index]))
            if run.first_by_id and index == 0:
                rows = rows[["u", "v", "id"]].astype(rows[["u", "v", "id"]].dtype)
            message = make_cloud(make_message, frame.stamp_ns, "camera", rows)
            clock, cpu = time.perf_counter(), time.process_time()
            result = localizer.localize_keypoints(message)
            run.seconds.append(time.perf_counter() - clock)
            run.cpu.append(time.process_time() - cpu)
            if result:
                _judge_frame(run, result, frame)


def _judge_frame(run: Run, result: Localized, frame: SimulatedFrame) -> None:
    error = np.linalg.norm(result.pose.position - frame.first_row.positions[0])
    run.localized += bool(error < _LOST)
    assert run.landmarks.ids is not None
    true = run.landmarks.ids[frame.ids[frame.inliers]]
    run.right.append(float(np.isin(result.inliers["id"], true).mean()))


def _fast_enough(run: Run) -> Claim:
    clock, cpu = run.milliseconds
    return Statement(
        f"matching.{run.name}_rate",
        "this project",
        f"{_SEEN.points} keypoints in a map of {_LANDMARKS:,} landmarks are matched and localized "
        f"at {run.at_least:g} Hz or more: {run.label}",
        f"median of the CPU time of a frame at most {1e3 / run.at_least:.3g} ms",
    ).judged(
        f"{cpu:.3g} ms, {1e3 / cpu:.0f} Hz ({clock:.3g} ms by the clock)", cpu <= 1e3 / run.at_least
    )


def _recognized(runs: Sequence[Run]) -> list[Claim]:
    usual = [run for run in runs if not run.first_by_id]
    unclear, predicted = (run for run in runs if run.first_by_id)
    return [
        Statement(
            "matching.localized",
            "this project",
            "where landmarks look different, every frame is localized, by right matches",
            f"all frames to {100 * _LOST:g} cm, 99 % of the inliers right, however matched",
        ).judged(
            "; ".join(
                f"{run.label}: {run.localized} of {len(run.seconds)}, {run.rightness:.1%}"
                for run in usual
            ),
            all(run.localized == len(run.seconds) and run.rightness >= 0.99 for run in usual),
        ),
        Statement(
            "matching.alike",
            "this project",
            f"where {_ALIKE} landmarks each look the same, a tracked camera is localized all the "
            "same, because only landmarks near their prediction compete",
            "all frames after a first one by id; without the prediction none of them",
        ).judged(
            f"{predicted.localized} of {len(predicted.seconds)} and {unclear.localized}",
            predicted.localized == len(predicted.seconds) and unclear.localized <= 1,
        ),
    ]


def _row(run: Run) -> tuple[str | float, ...]:
    return (run.label, *run.milliseconds, len(run.seconds), run.localized, run.rightness)


def _text(runs: Sequence[Run]) -> str:
    lines = [f"{'':24} {'ms':>7} {'CPU ms':>7} {'Hz':>6} {'localized':>10} {'right':>7}"]
    for run in runs:
        clock, cpu = run.milliseconds
        lines.append(
            f"{run.label:24} {clock:7.1f} {cpu:7.1f} {1e3 / clock:6.0f} "
            f"{run.localized:5d}/{len(run.seconds):<4d} {run.rightness:7.1%}"
        )
    return "\n".join(lines)
