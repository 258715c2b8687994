# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The rolling-shutter solvers start where P3P leaves off."""

from __future__ import annotations

import numpy as np

from benchmarks.experiments import charts
from benchmarks.experiments import methods as m
from benchmarks.experiments.motion import SPEEDS, TRANSLATION, X_LABEL, equal_to_r6p
from benchmarks.experiments.results import Context, Result, limited
from benchmarks.experiments.sweeps import POSE, Curves, Initial, sweep
from benchmarks.experiments.trials import Setting

_METHODS = (m.P3P, m.R6P, m.VCWT_ONCE, m.VCWT, m.VCWT_OURS)


def run(context: Context) -> Result:
    """The experiment."""

    def curves(initial: Initial | None) -> Curves:
        return sweep(
            context, "deg_per_frame", SPEEDS,
            lambda speed: Setting(speed, TRANSLATION * speed), _METHODS, initial,
        )  # fmt: skip

    best = curves(lambda trials, _: m.best_triplet(trials).rotation)
    plausible = curves(lambda trials, _: m.plausible_triplet(trials).rotation)
    excess = plausible.moving(m.VCWT_OURS) / curves(None).moving(m.VCWT_OURS)
    return Result(
        "P3P initialisation",
        "Motion as in the experiment of that name, without noise; the initial orientation is "
        "P3P's. `p3p_initialisation.csv` has the paper's triplet of the six points, that nearest "
        "to the truth; `p3p_initialisation_plausible.csv` one that can be had, the triplet that "
        "fits all points of the frame best.",
        [
            equal_to_r6p(
                "p3p-initialisation", [best], m.VCWT_ONCE,
                why="an initial orientation that is degrees off leaves an error of second order in "
                "v in the one product that the iteration fixes; it is gone with further iterations",
            ),
            equal_to_r6p("p3p-initialisation", [best, plausible]),
            limited(
                "p3p-initialisation.relinearized",
                "relinearized, P3P's orientation is as good a start as the truth",
                "medians of the pose, from the plausible triplet, over those from the truth",
                np.max(excess[:, POSE]).item(), most=1.1,
            ),
        ],
        {"p3p_initialisation": best.table(), "p3p_initialisation_plausible": plausible.table()},
        {"p3p_initialisation": charts.error_figure(best, _METHODS, X_LABEL)},
    )  # fmt: skip
