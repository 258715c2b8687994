# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors when the initial orientation is off: how far linearised rotations reach."""

import numpy as np

from benchmarks.experiments import methods as m
from benchmarks.experiments.motion import equal_to_r6p
from benchmarks.experiments.results import Claim, Context, Result, limited
from benchmarks.experiments.sweeps import ORIENTATION, POSITION, Curves, crossing, sweep
from benchmarks.experiments.trials import Setting, random_rotations

_OFFSETS = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 15.0, 18.0, 21.0, 25.0, 30.0)
_SPEED, _TRANSLATION = 15.0, 0.15
_METHODS = (m.P3P, m.R6P, *m.TWO_STEP, m.VCWT, m.VCWT_OURS, m.R9P, m.R9P_OURS)


def run(context: Context) -> Result:
    """The initial orientation is off, about any axis, at 15 degrees and 0.15 per frame.

    No noise; P3P needs no start. Five iterations. Once the camera's centre moves straight, once the
    scene drifts straight.
    """

    def curves(drifting: bool) -> Curves:
        return sweep(
            context, _OFFSETS,
            lambda _: Setting(_SPEED, _TRANSLATION, drifting=drifting), _METHODS,
            lambda trials, offset: random_rotations(len(trials), context.seed, offset)
            @ trials.truth.rotation,
        )  # fmt: skip

    straight, drifting = curves(drifting=False), curves(drifting=True)

    def useful(what: str, metric: int, reach: float) -> Claim:
        passes = [
            min(crossing(c.x, c.medians(m.VCWT)[:, metric], c.medians(m.P3P)[:, metric]), c.x[-1])
            for c in (straight, drifting)
        ]
        return limited(
            f"linearisation.useful_{what}",
            f"paper: {m.VCWT.label} beats P3P in {what} up to about {reach:g} degrees",
            f"its median passes that of P3P (deg, {_OFFSETS[-1]:g}: nowhere)", passes, least=reach,
        )  # fmt: skip

    growth = straight.medians(m.VCWT_OURS) / straight.medians(m.VCWT_OURS)[0]
    return Result(
        [
            equal_to_r6p("linearisation", [straight, drifting]),
            useful("orientation", ORIENTATION, 15.0),
            useful("centre", POSITION, 6.0),
            limited(
                "linearisation.relinearized_flat",
                "relinearized, it does not matter how far off the initial orientation is",
                f"medians up to {_OFFSETS[-1]:g} degrees over those from the truth",
                np.max(growth).item(), most=1.05,
            ),
        ],
        [straight.orientations("deg", 0, 6, 15, 30).replace("motion", "start off by", 1)],
    )  # fmt: skip
