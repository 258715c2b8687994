# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Markers on three walls and a cube among them: how well each method's pose fits the images."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.experiments import charts
from benchmarks.experiments import methods as m
from benchmarks.experiments.augmented_reality_claims import QUANTILES, Frames, claims
from benchmarks.experiments.methods import available
from benchmarks.experiments.plain_ransac import PlainRansac
from benchmarks.experiments.results import Context, Result, Table, Track
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.shutter import project_rolling
from rs_localizer.evaluation.cube_clip import (
    CLIP_SENSOR,
    OURS,
    P3P,
    RUN_UP,
    Clip,
    clip_stamps,
    draw_clip,
)
from rs_localizer.io.trajectories import Trajectory, read_tum
from rs_localizer.localizer import Localizer
from rs_localizer.simulation.marker_frames import CAMERA, MarkerFrame, MarkerWalls
from rs_localizer.solvers.table import SOLVERS
from rs_localizer.tracking import Tracker

# As published; and R9P as the package has it.
_PLAIN = (*m.PAPERS, m.R9P_OURS)
_SAMPLES = 100
_THRESHOLD = 2.0
_FRAMES_PER_TRIAL, _LEAST_FRAMES = 0.15, 40
_CLIP_FRAMES_PER_TRIAL = 0.05
# Markers of a frame that counts.
_LEAST_MARKERS = 3
# Each frame is timed so often; the least is what the machine needs when it is left alone.
_REPEATS = 3
_OURS = "the Localizer, with any rolling-shutter solver"
# What the figure shows (px).
_SHOWN = (0.01, 100.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Estimates:
    """What one solver's Localizer makes of all frames."""

    errors: list[Array]  # px, of all corners of each frame
    positions: Array  # (frames,) m, error; infinite without a pose
    seconds: Array  # (frames,)


def run(context: Context) -> Result:
    """The experiment."""
    trajectory = read_tum(context.hand_motion)
    walls = MarkerWalls(trajectory, context.seed)
    stamps = walls.stamps()
    count = int(np.clip(_FRAMES_PER_TRIAL * context.trials, _LEAST_FRAMES, len(stamps)))
    chosen = [stamps[i] for i in np.unique(np.linspace(0, len(stamps) - 1, count).astype(int))]
    frames = [frame for frame, _ in context.track(walls.frames(chosen), len(chosen))]
    shown = [frame for frame in frames if frame.visible >= _LEAST_MARKERS]
    deep = [frame for frame in shown if len(frame.points) and not frame.is_flat]
    plain = {
        method.name: np.concatenate([_plain_errors(f, method, context.seed) for f in deep])
        for method in available(_PLAIN)
    }
    estimates = {solver: _localize(shown, solver) for solver in SOLVERS}
    products = {solver: np.concatenate(found.errors) for solver, found in estimates.items()}
    clip = _cube_clip(trajectory, context.trials, context.seed, context.track)
    found = Frames(
        taken=len(frames),
        speeds=np.array([frame.speed for frame in shown]),
        plain=plain,
        plain_owners=_owners(deep),
        products=products,
        owners=_owners(shown),
        positions={solver: e.positions for solver, e in estimates.items()},
        seconds={solver: e.seconds for solver, e in estimates.items()},
        cube=clip.errors,
    )
    return Result(
        "Augmented reality",
        f"{len(frames)} rendered images of three perpendicular walls of markers (640x480, 30 ms "
        "readout, 5 ms exposure, noise of 2 grey levels), evenly along the recorded motion of a "
        f"hand that looks all around; {len(shown)} of them have {_LEAST_MARKERS} or more markers "
        "in full view, by the truth. Markers are found by the package's own detector. The error "
        "is that of all their corners, each predicted at its own row's pose; a frame without a "
        f"pose has infinite errors. Left: the best of {_SAMPLES} minimal models, as in the paper, "
        f"on the {len(deep)} frames that show more than one wall (six points of a plane are no "
        f"sample for R6P); R9P by its own model. Right: the Localizer with at most "
        f"{_SAMPLES} samples, all frames, each for itself.",
        claims(found),
        {
            "augmented_reality": _quantile_table(plain, products),
            "augmented_reality_frames": _frame_table(shown, estimates),
            "augmented_reality_cube": Table(
                ("frame", *clip.errors),
                [(k, *row) for k, row in enumerate(np.column_stack(list(clip.errors.values())))],
            ),
        },
        {"augmented_reality": _figure(plain, products)},
        files={"cube.gif": clip.animation},
    )


def _owners(frames: Sequence[MarkerFrame]) -> IntArray:
    """The frame of each corner."""
    return np.repeat(np.arange(len(frames)), [len(frame.points) for frame in frames])


def _errors(
    poses_at: Callable[[Array], tuple[Array, Array]], points: Array, pixels: Array
) -> Array:
    """Distances (n,) of all detected corners from where a motion puts them, px."""
    predicted = project_rolling(CAMERA, poses_at, points)[0]
    errors: Array = np.linalg.norm(predicted - pixels, axis=1)
    return np.where(np.isnan(errors), np.inf, errors)


def _plain_errors(frame: MarkerFrame, method: m.Method, seed: int) -> Array:
    """With the best of so many minimal models, started from that of P3P."""
    search = PlainRansac.of(CAMERA, frame.points, frame.pixels, _SAMPLES, _THRESHOLD, seed)
    best = search.best(m.P3P)
    if method is not m.P3P:
        best = search.best(method, best.rotation)
    if best.poses_at is None:
        return np.full(len(frame.points), np.inf)
    return _errors(best.poses_at, frame.points - frame.points.mean(axis=0), frame.pixels)


def _localize(frames: Sequence[MarkerFrame], solver: str) -> _Estimates:
    localizer = Localizer(CAMERA, solver=solver, max_iterations=_SAMPLES)
    localizer.warm_up()
    errors, positions, seconds = [], [], []
    for frame in frames:
        times = []
        for _ in range(_REPEATS):
            start = time.perf_counter()
            found = localizer.localize(frame.points, frame.pixels)
            times.append(time.perf_counter() - start)
        seconds.append(min(times))
        if found:
            errors.append(_errors(found.at_rows, frame.points, frame.pixels))
            positions.append(float(np.linalg.norm(found.position - frame.position)))
        else:
            errors.append(np.full(len(frame.points), np.inf))
            positions.append(np.inf)
    return _Estimates(errors, np.array(positions), np.array(seconds))


def _quantile_table(plain: Mapping[str, Array], products: Mapping[str, Array]) -> Table:
    columns = [np.quantile(errors, QUANTILES, method="lower") for errors in plain.values()]
    columns += [np.quantile(errors, QUANTILES, method="lower") for errors in products.values()]
    names = [f"{name}_best_of_{_SAMPLES}" for name in plain] + [f"{n}_localizer" for n in products]
    return Table(
        ("share_of_corners", *(f"{name}_px" for name in names)),
        [tuple(map(float, row)) for row in np.column_stack([QUANTILES, *columns])],
    )


def _frame_table(frames: Sequence[MarkerFrame], estimates: Mapping[str, _Estimates]) -> Table:
    names = tuple(f"{solver}_position_m" for solver in estimates)
    return Table(
        ("stamp_ns", "markers_visible", "corners_detected", "deg_per_s", *names),
        [
            (frame.stamp_ns, frame.visible, len(frame.points), frame.speed,
             *(float(e.positions[k]) for e in estimates.values()))
            for k, frame in enumerate(frames)
        ],
    )  # fmt: skip


def _figure(plain: Mapping[str, Array], products: Mapping[str, Array]) -> Figure:
    drawn = charts.figure(9.6, 5.0)
    left, right = drawn.subplots(1, 2, sharey=True)
    for method in available(_PLAIN):
        _quantile_line(left, plain[method.name], charts.look(method), method.label)
    left.set_title(f"best of {_SAMPLES} minimal models\n(frames with two or three walls)")
    _quantile_line(right, products["p3p"], charts.look(m.P3P), m.P3P.label)
    for solver in products:
        if solver != "p3p":
            _quantile_line(right, products[solver], charts.look(m.REFINED), "")
    # The legend is that of the left.
    charts.line(left, np.empty(0), np.empty(0), charts.look(m.REFINED), _OURS)
    right.set_title(f"the Localizer, {_SAMPLES} samples\n(all frames with three markers or more)")
    left.set_ylim(*_SHOWN)
    charts.plain_logarithmic(left)
    for axes in (left, right):
        charts.tidy(axes, "share of the markers' corners (%)", "")
        axes.set_xlim(0.0, 100.0)
    left.set_ylabel("their reprojection error is at most (px)")
    charts.legend(drawn, left, columns=3)
    return drawn


def _quantile_line(axes: Axes, errors: Array, style: charts.Look, label: str) -> None:
    shares = np.linspace(0.02, 0.99, 98)
    values = np.quantile(errors, shares, method="lower")
    charts.line(axes, 100.0 * shares, values, style, label)
    axes.lines[-1].set_markevery(8)


def _cube_clip(trajectory: Trajectory, trials: int, seed: int, track: Track) -> Clip:
    """Localize every image of the clip by both methods and draw the cube by their poses."""
    walls = MarkerWalls(trajectory, seed, CLIP_SENSOR)
    stamps = clip_stamps(walls, max(8, round(_CLIP_FRAMES_PER_TRIAL * trials)))
    p3p = Localizer(CAMERA, solver="p3p", max_iterations=_SAMPLES)
    ours = Tracker(Localizer(CAMERA, max_iterations=_SAMPLES))
    middles, images, motions = [], [], []
    for frame, image in track(walls.frames(stamps), len(stamps)):
        found = {
            P3P: p3p.localize(frame.points, frame.pixels),
            OURS: ours.localize(frame.middle_ns, frame.points, frame.pixels),
        }
        middles.append(frame.middle_ns)
        images.append(image)
        motions.append({name: motion or None for name, motion in found.items()})
    return draw_clip(walls, middles[RUN_UP:], images[RUN_UP:], motions[RUN_UP:])
