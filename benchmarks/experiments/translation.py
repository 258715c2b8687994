# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of a camera that moves without turning."""

from __future__ import annotations

import numpy as np

from benchmarks.experiments import charts
from benchmarks.experiments import methods as m
from benchmarks.experiments.errors import ORIENTATION, POSITION, T
from benchmarks.experiments.motion import CHOICE, joint_is_best
from benchmarks.experiments.results import Claim, Context, Result, Statement
from benchmarks.experiments.sweeps import Curves, crossing, sampled, sweep
from benchmarks.experiments.trials import Setting

_SPEEDS = tuple(np.linspace(0.0, 0.3, 11).tolist())
_FROM = 0.1  # per frame
_X_LABEL = "translation per frame"
_REST = (
    "Below {:.3f} per frame P3P has the best orientation: noise outweighs the motion, and a pose "
    "alone has fewer unknowns. P3P's is the triplet nearest to the truth, which nobody can pick."
)


def run(context: Context) -> Result:
    """The experiment."""
    curves = sweep(
        context, "per_frame", _SPEEDS, lambda speed: Setting(linear=speed, noise=1.0), m.ALL
    )
    passes = crossing(
        curves.x, curves.median(m.P3P, ORIENTATION), curves.median(m.VCT_W, ORIENTATION)
    )
    return Result(
        "Pure translation",
        "Translation up to 0.3 per frame without rotation, 1 px noise; everything else as under "
        "Motion.",
        [_ahead(curves), joint_is_best("translation", curves)],
        {"translation": curves.table()},
        {
            "translation": charts.error_figure(curves, (*m.PAPERS, m.JOINT, m.REFINED), _X_LABEL),
            "choosing_translation": charts.error_figure(
                curves, CHOICE, _X_LABEL, (ORIENTATION, POSITION)
            ),
        },
        [_REST.format(passes)],
    )


def _ahead(curves: Curves) -> Claim:
    ahead = (m.VCT_W, m.VCT_WT)
    others = [x for x in m.PAPERS if x not in ahead and curves.has(x)]
    places = curves.x >= _FROM - 1e-9

    def worst(curves: Curves) -> float:
        ratios = []
        for metric in (ORIENTATION, POSITION, T):
            rivals = [x for x in others if not (x is m.P3P and metric == T)]
            best = np.min([curves.median(x, metric)[places] for x in rivals], axis=0)
            ours = np.max([curves.median(x, metric)[places] for x in ahead], axis=0)
            ratios.append(float(np.max(ours / best)))
        return max(ratios)

    found = sampled(worst, curves)
    return Statement(
        "translation.vct_ahead",
        "paper: pure translation",
        "R6P v,C,t | w and v,C,t | w,t are ahead of all others",
        f"from {_FROM:g} per frame on, medians of orientation, position and t of both below those "
        "of every other solver of the paper",
    ).judged_by(f"at most {found.value:.2f} times the best of the others", [found], (-np.inf, 1.0))
