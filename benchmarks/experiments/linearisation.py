# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors when the initial orientation is off: how far linearised rotations reach."""

from __future__ import annotations

import numpy as np

from benchmarks.experiments import charts
from benchmarks.experiments import methods as m
from benchmarks.experiments.errors import ORIENTATION, POSITION
from benchmarks.experiments.motion import equal_to_r6p
from benchmarks.experiments.results import Claim, Context, Result, Statement
from benchmarks.experiments.sweeps import Curves, crossing, sampled, sweep
from benchmarks.experiments.trials import Setting, random_rotations

_OFFSETS = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 15.0, 18.0, 21.0, 25.0, 30.0)
_SPEED, _TRANSLATION = 15.0, 0.15
# R6P gives solutions with |v| < 0.6 alone: up to 31 degrees from the initial orientation.
_R6P_REACH = 25.0
_X_LABEL = "initial orientation off by (deg)"
_METHODS = (m.P3P, m.R6P, *m.TWO_STEP, m.VCWT, m.VCWT_OURS, m.R9P, m.R9P_OURS)


def run(context: Context) -> Result:
    """The experiment."""

    def curves(drifting: bool) -> Curves:
        return sweep(
            context, "initial_error_deg", _OFFSETS,
            lambda _: Setting(_SPEED, _TRANSLATION, drifting=drifting), _METHODS,
            lambda trials, offset: random_rotations(len(trials), context.seed, offset)
            @ trials.truth.rotation,
        )  # fmt: skip

    straight, drifting = curves(drifting=False), curves(drifting=True)
    return Result(
        "Linearisation",
        f"The initial orientation is off by an angle, about any axis, at {_SPEED:g} degrees and "
        f"{_TRANSLATION:g} per frame, without noise. P3P needs none. Five iterations.",
        [
            equal_to_r6p("linearisation", [straight, drifting], up_to=_R6P_REACH),
            _useful("orientation", ORIENTATION, 15.0, straight, drifting),
            _useful("centre", POSITION, 6.0, straight, drifting),
            _relinearised(straight),
        ],
        {"linearisation": straight.table(), "linearisation_drifting": drifting.table()},
        {"linearisation": charts.error_figure(straight, _METHODS, _X_LABEL, skip_zero=False)},
    )


def _useful(what: str, metric: int, reach: float, straight: Curves, drifting: Curves) -> Claim:
    reaches = []
    for curves in (straight, drifting):
        passes = crossing(curves.x, curves.median(m.VCWT, metric), curves.median(m.P3P, metric))
        reaches.append(np.inf if np.isnan(passes) else passes)
    listed = [f"{x:.0f}" if np.isfinite(x) else f"more than {_OFFSETS[-1]:.0f}" for x in reaches]
    return Statement(
        f"linearisation.useful_{what}",
        "paper: linearisation",
        f"{m.VCWT.label} beats P3P in {what} up to about {reach:g} degrees from the linearisation",
        f"its median passes that of P3P at {reach:g} degrees or later",
    ).judged(
        f"{listed[0]} deg where the camera's centre moves straight, {listed[1]} where the scene "
        "drifts straight",
        min(reaches) >= reach,
    )


def _relinearised(curves: Curves) -> Claim:
    def growth(curves: Curves) -> float:
        values = curves.medians(m.VCWT_OURS)
        return float(np.max(values / values[0])) - 1.0

    found = sampled(growth, curves)
    return Statement(
        "linearisation.relinearized_flat",
        "this project",
        "relinearized, it does not matter how far off the initial orientation is",
        f"all medians up to {_OFFSETS[-1]:g} degrees within 5 % of those from the truth",
    ).judged_by(f"at most {found.value:+.1%}", [found], (-np.inf, 0.05))
