# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of a camera that moves without turning."""

import numpy as np

from benchmarks.experiments import methods as m
from benchmarks.experiments.motion import joint_is_best
from benchmarks.experiments.results import Context, Result, limited
from benchmarks.experiments.sweeps import ORIENTATION, POSITION, T, crossing, sweep
from benchmarks.experiments.trials import Setting

_SPEEDS = tuple(np.linspace(0.0, 0.3, 11).tolist())
_FROM = 0.1  # per frame
_REST = (
    "Below {:.3f} per frame P3P has the best orientation: noise outweighs the motion.\n"
    "P3P's is the triplet nearest to the truth, which nobody can pick."
)


def run(context: Context) -> Result:
    """Translation up to 0.3 per frame, 1 px of noise; everything else as under ``motion``."""
    curves = sweep(context, _SPEEDS, lambda speed: Setting(linear=speed, noise=1.0), m.ALL)
    places = curves.x >= _FROM - 1e-9
    ratios = []
    for metric in (ORIENTATION, POSITION, T):
        rivals = (m.P3P, m.R6P, m.VC_WT, m.VCWT, m.R9P)[1 if metric == T else 0 :]
        best = np.min([curves.medians(x)[places, metric] for x in rivals], axis=0)
        ours = np.max([curves.medians(x)[places, metric] for x in (m.VCT_W, m.VCT_WT)], axis=0)
        ratios.append(np.max(ours / best))
    passes = crossing(
        curves.x, curves.medians(m.P3P)[:, ORIENTATION], curves.medians(m.VCT_W)[:, ORIENTATION]
    )
    return Result(
        [
            limited(
                "translation.vct_ahead",
                "paper: R6P v,C,t-w and v,C,t-w,t are ahead of all others",
                f"from {_FROM:g} per frame on, medians over the best of the others", ratios,
                most=1.0,
            ),
            joint_is_best("translation", curves),
        ],
        [curves.orientations("per frame", 0.0, 0.15, 0.3), _REST.format(passes)],
    )  # fmt: skip
