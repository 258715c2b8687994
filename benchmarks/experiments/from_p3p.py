# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""All solvers from the orientation that P3P finds: the paper's Fig. 5."""

from dataclasses import replace

import numpy as np

from benchmarks.experiments import methods as m
from benchmarks.experiments.motion import equal_to_r6p
from benchmarks.experiments.results import Context, Result, limited
from benchmarks.experiments.sweeps import POSE, Curves, sweep
from benchmarks.experiments.trials import Setting

_SPEEDS = (0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 20.0, 25.0, 30.0)  # deg per frame
_TRANSLATION = 0.01  # per degree
_METHODS = (m.P3P, m.R6P, *m.TWO_STEP, m.VCWT, m.VCWT_OURS, m.R9P, m.R9P_OURS)


def run(context: Context) -> Result:
    """The camera has any orientation, and the rolling-shutter solvers start from that of P3P.

    P3P is the best of all triplets of the six points; motion is as under ``motion``. One iteration
    and five without noise; one at 1 px.
    """

    def curves(iterations: int, noise: float) -> Curves:
        return sweep(
            context, _SPEEDS,
            lambda speed: Setting(speed, _TRANSLATION * speed, noise),
            [replace(method, iterations=iterations) for method in _METHODS],
            lambda trials, _: m.best_triplet(trials).rotation,
        )  # fmt: skip

    once, five, noisy = curves(1, 0.0), curves(5, 0.0), curves(1, 1.0)
    near = once.moving(m.VCWT)[:, POSE] / once.moving(m.R6P)[:, POSE]
    # P3P does not give the true orientation, so that the first iteration is never exact.
    beats = once.moving(m.VCWT)[:, POSE] / once.moving(m.P3P)[:, POSE]
    return Result(
        [
            limited(
                "from-p3p.vcwt_once_matches_r6p",
                "paper: started by P3P, one iteration of r6p_vcwt matches r6p",
                "its pose errors over those of r6p, medians", np.ravel(near), most=1.5,
            ),
            limited(
                "from-p3p.vcwt_beats_p3p", "paper: and it beats P3P",
                "its pose errors over those of P3P, medians", np.ravel(beats), most=1.0,
            ),
            equal_to_r6p("from-p3p", [five]),
        ],
        [
            each.orientations("deg", 6.0, 15.0, 30.0).replace("motion", f"from P3P{noise}", 1)
            for each, noise in ((once, ""), (noisy, ", 1 px"))
        ],
    )  # fmt: skip
