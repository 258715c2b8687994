# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What it brings to follow a moving camera from frame to frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from matplotlib.figure import Figure

from benchmarks.experiments import charts
from benchmarks.experiments.charts import Look
from benchmarks.experiments.results import Claim, Context, Result, Statement, Table
from benchmarks.experiments.uncertainty import IntArray, Interval, bootstrap
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.evaluation.plots import BLUE, ORANGE
from rs_localizer.io.trajectories import read_tum
from rs_localizer.localizer import Localizer
from rs_localizer.simulation.frames import SimulatedFrame, frame_stamps, simulate_frames
from rs_localizer.simulation.scene import room
from rs_localizer.simulation.settings import FrameSettings
from rs_localizer.simulation.true_motion import RecordedMotion
from rs_localizer.tracking import Tracker

_RATE = 30.0
_FRAMES_PER_TRIAL = 0.45  # 30 s at 2000 trials
_LEAST_FRAMES, _MOST_FRAMES = 90, 900
_READOUT_TIME = 0.03
_GAP = 60  # frames: 2 s
_BETWEEN_GAPS = 15
# A pose this far off is no good frame (m).
_LOST = 0.1
_WALL_DISTANCE, _WALL_SIZE, _WALL_POINTS = 2.0, 16.0, 40_000  # m, m, one
_QUARTILES = (0.25, 0.5, 0.75)
_POSITION, _VELOCITY = 0, 1


@dataclass(frozen=True, slots=True)
class Case:
    """What the camera sees."""

    name: str
    label: str
    settings: FrameSettings
    wall: bool = False


_CASES = (
    Case("few", "20 points", FrameSettings(points=20, outliers=0.0, rate=_RATE)),
    Case("wall", "150 points on a wall", FrameSettings(points=150, outliers=0.0, rate=_RATE),
         wall=True),
    Case("rich", "150 points, 30 % outliers", FrameSettings(points=150, rate=_RATE)),
)  # fmt: skip
_LOOKS = {"tracked": Look(BLUE, "", "-", 1.4), "untracked": Look(ORANGE, "", "--", 1.0)}


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """Errors (n,2) of position (m) and linear velocity (m/s) per frame, infinite without pose."""

    seconds: Array  # (n,)
    tracked: Array
    untracked: Array
    followed: Array  # (n,) whether the prediction alone was enough

    def ratio(self, quantile: float, column: int) -> Interval:
        """Tracked in units of untracked errors of position or velocity."""
        tracked, untracked = (errors[1:, column] for errors in (self.tracked, self.untracked))

        def of(chosen: IntArray) -> float:
            one, other = (
                np.quantile(errors[chosen], quantile, method="lower")
                for errors in (tracked, untracked)
            )
            return float(one / other)

        # Frames of one second are not independent.
        return bootstrap(of, len(tracked), self.seconds[1:].astype(np.int64))

    @property
    def share(self) -> float:
        """Of the frames after the first for which one starting orientation was enough."""
        return float(np.mean(self.followed[1:]))


def run(context: Context) -> Result:
    """The experiment."""
    wanted = int(np.clip(_FRAMES_PER_TRIAL * context.trials, _LEAST_FRAMES, _MOST_FRAMES))
    camera = _camera()
    sequences = {case.name: _frames(case, camera, context, wanted) for case in _CASES}
    runs = {name: _run(camera, frames, context) for name, frames in sequences.items()}
    seconds = wanted / _RATE
    return Result(
        "Tracking",
        f"The first {seconds:.0f} s of the recorded motion of a hand, {_RATE:g} frames per second "
        f"of a camera of 640x480 with a readout of {1e3 * _READOUT_TIME:g} ms, 1 px noise; in a "
        "room, and before one wall. Tracked and untracked, both at the defaults, get the same "
        "frames; ratios are those of medians.",
        [
            *(_improves(case, runs[case.name]) for case in _CASES[:2]),
            _never_worse(_CASES[2], runs["rich"]),
            _one_start(runs),
            _after_a_gap(camera, sequences["rich"]),
        ],
        {"tracking": Table(_COLUMNS, _rows(runs)), "tracking_frames": _frame_table(runs)},
        {"tracking": _figure(runs)},
    )


_COLUMNS = (
    "case", "method", "quantile", "position_m", "linear_velocity_m_per_s", "localized", "tracked"
)  # fmt: skip


def _camera() -> Camera:
    K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
    return Camera(width=640, height=480, K=K, readout_time=_READOUT_TIME)


def _frames(case: Case, camera: Camera, context: Context, wanted: int) -> list[SimulatedFrame]:
    motion = RecordedMotion(read_tum(context.hand_motion))
    stamps = frame_stamps(motion, camera, _RATE)[:wanted]
    points = _map(case, motion, np.random.default_rng(context.seed))
    simulated = simulate_frames(
        camera, motion, points, case.settings, stamps_ns=stamps, seed=context.seed
    )
    return list(islice(context.track(simulated, len(stamps)), wanted))


def _map(case: Case, motion: RecordedMotion, rng: np.random.Generator) -> Array:
    first, last = motion.intervals_ns[0]
    way = motion.state(first, np.linspace(0.0, (last - first) * 1e-9, 400)).positions
    if not case.wall:
        return room(way, rng)
    # Across x, along which the camera mostly looks in this part of the motion.
    half = 0.5 * _WALL_SIZE
    y, z = rng.uniform(-half, half, (2, _WALL_POINTS))
    x = np.full(_WALL_POINTS, way[:, 0].max() + _WALL_DISTANCE)
    return np.column_stack([x, y + way[:, 1].mean(), z + way[:, 2].mean()])


def _run(camera: Camera, frames: Sequence[SimulatedFrame], context: Context) -> Run:
    localizer = Localizer(camera)
    tracker = Tracker(localizer)
    tracked, untracked, followed = [], [], []
    for frame in context.track(frames, len(frames)):
        result = tracker.localize(frame.middle_ns, frame.points, frame.pixels)
        tracked.append(_errors(result, frame))
        untracked.append(_errors(localizer.localize(frame.points, frame.pixels), frame))
        followed.append(result.tracked if result else False)
    start = frames[0].stamp_ns
    seconds = np.array([(frame.stamp_ns - start) * 1e-9 for frame in frames])
    return Run(seconds, np.array(tracked), np.array(untracked), np.array(followed))


def _errors(result: Estimate | Failure, frame: SimulatedFrame) -> tuple[float, float]:
    if not result:
        return np.inf, np.inf
    truth = frame.motion
    velocity = (result.linear_velocity - truth.linear_velocity) / frame.readout_time
    position = result.position - frame.middle_row.positions[0]
    return float(np.linalg.norm(position)), float(np.linalg.norm(velocity))


def _improves(case: Case, found: Run) -> Claim:
    ratios = [found.ratio(0.5, column) for column in (_POSITION, _VELOCITY)]
    return Statement(
        f"tracking.{case.name}",
        "this project",
        f"tracking makes weak frames much better: {case.label}",
        "median errors of position and linear velocity at most 0.6 of the untracked ones",
    ).judged_by(
        f"{ratios[_POSITION].value:.2f} and {ratios[_VELOCITY].value:.2f}", ratios, (-np.inf, 0.6)
    )


def _never_worse(case: Case, found: Run) -> Claim:
    ratios = [
        [found.ratio(quantile, column) for quantile in _QUARTILES]
        for column in (_POSITION, _VELOCITY)
    ]
    listed = [", ".join(f"{x.value:.2f}" for x in of_column) for of_column in ratios]
    return Statement(
        f"tracking.{case.name}",
        "this project",
        f"tracking never makes rich frames worse: {case.label}",
        "no quartile of the errors of position and linear velocity above the untracked one",
    ).judged_by(
        f"quartiles {listed[_POSITION]} and {listed[_VELOCITY]} of the untracked ones",
        [*ratios[_POSITION], *ratios[_VELOCITY]],
        (-np.inf, 1.0),
    )


def _one_start(runs: Mapping[str, Run]) -> Claim:
    shares = {name: found.share for name, found in runs.items()}
    return Statement(
        "tracking.one_start",
        "this project",
        "one starting orientation, the predicted one, mostly suffices",
        "in at least 95 % of the frames of each kind",
    ).judged(
        ", ".join(f"{name} {share:.1%}" for name, share in shares.items()),
        min(shares.values()) >= 0.95,
    )


def _after_a_gap(camera: Camera, frames: Sequence[SimulatedFrame]) -> Claim:
    tracker = Tracker(Localizer(camera))
    found = []
    for start in range(0, len(frames) - _GAP - 1, _BETWEEN_GAPS):
        for frame in (frames[start], frames[start + 1], frames[start + 1 + _GAP]):
            result = tracker.localize(frame.middle_ns, frame.points, frame.pixels)
        found.append(_errors(result, frame)[_POSITION] < _LOST)
        tracker.reset()
    return Statement(
        "tracking.gap",
        "this project",
        "after a gap of 2 s the first frame is localized",
        f"every one, to {100 * _LOST:g} cm",
    ).judged(f"{sum(found)} of {len(found)}", all(found))


def _rows(runs: Mapping[str, Run]) -> list[tuple[str | float, ...]]:
    rows: list[tuple[str | float, ...]] = []
    for case, found in runs.items():
        for method, errors, share in (
            ("tracked", found.tracked, found.share),
            ("untracked", found.untracked, 0.0),
        ):
            localized = float(np.mean(np.isfinite(errors[:, 0])))
            for quantile in _QUARTILES:
                values = np.quantile(errors, quantile, axis=0, method="lower")
                rows.append(
                    (case, method, quantile, float(values[0]), float(values[1]), localized, share)
                )
    return rows


def _frame_table(runs: Mapping[str, Run]) -> Table:
    return Table(
        ("case", "s", "tracked_m", "untracked_m", "tracked_m_per_s", "untracked_m_per_s",
         "one_start"),
        [
            (name, float(s), *(float(x) for x in (t[0], u[0], t[1], u[1])), int(one))
            for name, run in runs.items()
            for s, t, u, one in zip(
                run.seconds, run.tracked, run.untracked, run.followed, strict=True
            )
        ],
    )  # fmt: skip


def _figure(runs: Mapping[str, Run]) -> Figure:
    drawn = charts.figure(11.0, 7.4)
    panels = drawn.subplots(len(_CASES), 2, sharex=True)
    for row, case in zip(panels, _CASES, strict=True):
        found = runs[case.name]
        for column, (axes, label) in enumerate(
            zip(row, ("position error (m)", "linear velocity error (m/s)"), strict=True)
        ):
            for method, errors in (("untracked", found.untracked), ("tracked", found.tracked)):
                charts.line(axes, found.seconds, errors[:, column], _LOOKS[method], method)
            axes.set_title(case.label, fontsize=10)
            charts.plain_logarithmic(axes)
            charts.tidy(axes, "time (s)" if case is _CASES[-1] else "", label)
    charts.legend(drawn, panels[0, 0])
    return drawn
