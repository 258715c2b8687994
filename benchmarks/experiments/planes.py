# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Planes: one image of a plane does not show a rolling shutter's velocities; a prior helps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from benchmarks.experiments import charts
from benchmarks.experiments.charts import Look
from benchmarks.experiments.errors import angles
from benchmarks.experiments.plain_ransac import observe
from benchmarks.experiments.results import Claim, Context, Result, Statement, Table
from benchmarks.experiments.trials import Setting, camera
from benchmarks.experiments.uncertainty import quantile
from benchmarks.experiments.views import View, synthetic_views
from rs_localizer.config import VelocityPrior
from rs_localizer.core.arrays import Array
from rs_localizer.core.state import rotation_of
from rs_localizer.estimation.posterior import maximum_a_posteriori
from rs_localizer.estimation.prior import motion_terms, state_in
from rs_localizer.evaluation.plots import BLUE, ORANGE
from rs_localizer.localizer import Localizer

# 10 degrees and 0.1 m in a readout of 30 ms, which is assumed without one.
_PRIOR = VelocityPrior(angular=float(np.radians(10.0)) / 0.03, linear=0.1 / 0.03)
_NO_PRIOR = motion_terms((0.0, 0.0), (0.001, 0.001))
# A pose that fits none of the rows but all of them roughly needs every point.
_WIDE = 100.0  # px
# One takes some steps only, and the valley is long and flat: at rest it has no end.
_REFINEMENTS = 20
_TRIALS_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class Case:
    """A plane, a motion, and how far the orientation may be off."""

    name: str
    label: str
    setting: Setting
    at_most: float  # deg


_CASES = (
    Case("rest", "fronto-parallel, at rest", Setting(noise=1.0, tilt=0.0), 0.35),
    Case("turning", "fronto-parallel, at 6 deg per readout",
         Setting(angular=6.0, linear=0.06, noise=1.0, tilt=0.0), 1.2),
    Case("tilted", "tilted by 30 deg, at 1.5 deg per readout",
         Setting(angular=1.5, linear=0.015, noise=1.0, tilt=30.0), 1.1),
)  # fmt: skip
_OURS, _FREE, _P3P = "localizer", "no_prior", "p3p"
_LABELS = {
    _OURS: "ours: the Localizer",
    _FREE: "12 parameters, no prior",
    _P3P: "global shutter (p3p)",
}
_LOOKS = {
    _OURS: Look(BLUE, "", "-", 2.2),
    _FREE: Look("#5aa0e0", "", ":", 1.8),
    _P3P: Look(ORANGE, "", "--", 1.6),
}


def run(context: Context) -> Result:
    """The experiment."""
    count = max(1, round(_TRIALS_SHARE * context.trials))
    ours = Localizer(camera(), velocity_prior=_PRIOR)
    global_shutter = Localizer(camera(), solver="p3p", inlier_threshold=_WIDE)
    found: dict[str, dict[str, Array]] = {}
    for case in _CASES:
        rows = [
            (_error(ours, view), _unaided_error(view), _error(global_shutter, view))
            for view in context.track(synthetic_views(count, context.seed, case.setting), count)
        ]
        found[case.name] = dict(zip((_OURS, _FREE, _P3P), np.array(rows).T, strict=True))
    return Result(
        "Planes",
        "All points on a plane, 50 of them, 1 px noise; the camera stands 2 to 3 m away, and "
        f"moves by 0.01 m per degree that it turns. {count} frames of each kind. Prior of 10 "
        f"degrees and 0.1 m per readout; `{_FREE}` is the refinement without it and without the "
        f"choice between motion and rest, from the true motion; `{_P3P}` a global-shutter pose of "
        "all points. A frame without a pose counts as infinitely wrong.",
        [_claim(case, found[case.name]) for case in _CASES],
        {"planes": Table(_COLUMNS, _rows(found))},
        {"planes": _figure(found)},
    )


def _error(localizer: Localizer, view: View) -> float:
    """Of the orientation, deg; infinite without a pose."""
    result = localizer.localize(view.points, view.pixels)
    return float(angles(result.rotation, view.motion.rotation)) if result else np.inf


def _unaided_error(view: View) -> float:
    """The same for twelve parameters that only the points determine, from the best start."""
    start = state_in(view.motion, view.points.mean(axis=0))
    observations = observe(view.camera, view.points, view.pixels)
    state = start
    for _ in range(_REFINEMENTS):
        state = maximum_a_posteriori(observations, state, _NO_PRIOR, _WIDE).state
    return float(angles(rotation_of(state), view.motion.rotation))


_COLUMNS = ("case", "method", "orientation_deg_q25", "median", "q75", "no_pose")


def _claim(case: Case, errors: Mapping[str, Array]) -> Claim:
    medians = {name: float(np.median(values)) for name, values in errors.items()}
    others = ", ".join(f"{medians[name]:.2f} with {_LABELS[name]}" for name in (_FREE, _P3P))
    return Statement(
        f"planes.{case.name}",
        "this project",
        f"the velocity prior makes a plane usable: {case.label}",
        f"median orientation error at most {case.at_most:g} deg",
    ).judged_by(
        f"{medians[_OURS]:.2f} deg ({others})", [quantile(errors[_OURS])], (-np.inf, case.at_most)
    )


def _rows(found: Mapping[str, Mapping[str, Array]]) -> Sequence[Sequence[str | float]]:
    return [
        (
            case,
            method,
            *(float(x) for x in np.quantile(errors, (0.25, 0.5, 0.75), method="lower")),
            float(np.mean(np.isinf(errors))),
        )
        for case, methods in found.items()
        for method, errors in methods.items()
    ]


def _figure(found: Mapping[str, Mapping[str, Array]]) -> Figure:
    drawn = charts.figure(11.0, 4.4)
    panels = drawn.subplots(1, len(_CASES), sharey=True)
    for axes, case in zip(panels, _CASES, strict=True):
        for method, errors in found[case.name].items():
            shares = 100.0 * (np.arange(len(errors)) + 0.5) / len(errors)
            charts.line(axes, np.sort(errors), shares, _LOOKS[method], _LABELS[method])
        axes.set_xscale("log")
        axes.axvline(case.at_most, color="#000000", linewidth=0.8)
        axes.set_title(case.label, fontsize=10)
        charts.tidy(axes, "orientation error (deg)", "frames (%)")
    charts.legend(drawn, panels[0])
    return drawn
