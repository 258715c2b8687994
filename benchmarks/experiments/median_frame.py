"""What an ordinary frame costs, and what it keeps, beside PoseLib's global-shutter estimate."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.experiments.competitors import poselib, poselib_camera
from benchmarks.experiments.results import Claim, Context, Statement, Table
from benchmarks.experiments.trials import Setting, camera
from benchmarks.experiments.views import View, synthetic_views
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.localizer import Localizer

_FRAME = Setting(angular=10.0, linear=0.1, noise=1.0, points=200)
_OUTLIERS = 0.5
_FRAMES_PER_TRIAL = 0.025
_FEWEST, _MOST = 10, 100
# Each frame several times: the median is the frame's, not the machine's.
_REPEATS = 5
_LEAST_KEPT = 0.97
_OURS = "Localizer.localize"
_POSELIB = "PoseLib estimate_absolute_pose"
# By default it takes 12 px and up to 100 000 samples, which it needs where few points fit a global
# shutter; with our own threshold and number of samples it gives up early, and is much faster.
_BOUNDED = f"{_POSELIB}, 2 px and 1000 samples"
_BOUNDS = {"max_reproj_error": 2.0, "max_iterations": 1000}


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Times and inliers of the same frames, by the method's name."""

    microseconds: dict[str, Array]  # (n,)
    kept: dict[str, Array]  # (n,) share of the true inliers

    def table(self) -> Table:
        return Table(
            ("frame", "method", "us", "true_inliers_kept"),
            [
                (index, name, float(us), float(kept))
                for name in self.kept
                for index, (us, kept) in enumerate(
                    zip(self.microseconds[name], self.kept[name], strict=True)
                )
            ],
        )

    def milliseconds(self, name: str) -> float:
        """Of the median frame."""
        return float(np.median(self.microseconds[name])) / 1000.0

    def share(self, name: str) -> float:
        """Of all true inliers."""
        return float(np.mean(self.kept[name]))


def examine_frames(context: Context) -> Frames:
    """Both take turns on each frame."""
    count = int(np.clip(_FRAMES_PER_TRIAL * context.trials, _FEWEST, _MOST))
    methods = _methods()
    times: dict[str, list[float]] = {name: [] for name in methods}
    kept: dict[str, list[float]] = {name: [] for name in methods}
    views = list(synthetic_views(count, context.seed, _FRAME, _OUTLIERS))
    for method in methods.values():
        method(views[0])  # compiles
    for view in context.track(views, count):
        turns: dict[str, list[float]] = {name: [] for name in methods}
        for _ in range(_REPEATS):
            for name, method in methods.items():
                start = time.perf_counter()
                method(view)
                turns[name].append(1e6 * (time.perf_counter() - start))
        for name, method in methods.items():
            times[name].append(float(np.median(turns[name])))
            kept[name].append(float(np.mean(method(view)[view.inliers])))
    return Frames(
        {name: np.array(values) for name, values in times.items()},
        {name: np.array(values) for name, values in kept.items()},
    )


def _methods() -> dict[str, Callable[[View], BoolArray]]:
    """By name: a frame's inliers."""
    localizer = Localizer(camera())

    def ours(view: View) -> BoolArray:
        result = localizer.localize(view.points, view.pixels)
        return result.inliers if result else np.zeros(len(view.points), dtype=np.bool_)

    methods: dict[str, Callable[[View], BoolArray]] = {_OURS: ours}
    module = poselib()
    if module is not None:
        model = poselib_camera(camera())

        def theirs(view: View, options: Mapping[str, float]) -> BoolArray:
            _, found = module.estimate_absolute_pose(
                view.pixels, view.points, model, dict(options), {}
            )
            return np.array(found["inliers"], dtype=np.bool_)

        methods[_POSELIB] = partial(theirs, options={})
        methods[_BOUNDED] = partial(theirs, options=_BOUNDS)
    return methods


def frame_claims(found: Frames) -> list[Claim]:
    """No slower than a global-shutter estimate, and nearly all inliers kept."""
    ours = found.share(_OURS)
    others = ", ".join(
        f"{name}: {found.share(name):.1%}" for name in (_POSELIB, _BOUNDED) if name in found.kept
    )
    return [
        _no_slower("median_frame", _POSELIB, found),
        _no_slower("median_frame_bounded", _BOUNDED, found),
        Statement(
            "timings.inliers_kept",
            "this project",
            "an ordinary frame keeps nearly all true inliers",
            f"over {_LEAST_KEPT:.0%} of them",
        ).judged(
            f"{ours:.1%}" + (f" ({others})" if others else ""),
            ours > _LEAST_KEPT,
        ),
    ]


def _no_slower(name: str, other: str, found: Frames) -> Claim:
    statement = f"an ordinary frame takes no longer than {other}"
    criterion = "median frame at most that of the same points in the same run (aim half)"
    if other not in found.kept:
        return Statement(f"timings.{name}", "this project", statement, criterion).not_tested(
            "PoseLib is not installed"
        )
    mine, theirs = found.milliseconds(_OURS), found.milliseconds(other)
    return Statement(f"timings.{name}", "this project", statement, criterion).judged(
        f"{mine:.2f} ms of {theirs:.2f} ms ({mine / theirs:.2f})",
        mine <= theirs,
        f"it stops after 1000 samples with {found.share(other):.0%} of the true inliers"
        if other == _BOUNDED
        else "",
    )


def frame_note(found: Frames) -> str:
    """What an ordinary frame is, and its figures."""
    figures = "; ".join(
        f"{name}: {found.milliseconds(name):.2f} ms, {found.share(name):.1%} of the true inliers"
        for name in found.kept
    )
    return (
        f"Ordinary frames: {_FRAME.points} points, {_OUTLIERS:.0%} outliers, {_FRAME.angular:g} "
        f"deg and {_FRAME.linear:g} m per readout, {_FRAME.noise:g} px noise, one core, at "
        f"the defaults where nothing else is said. {figures}."
    )
