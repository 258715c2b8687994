# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""From how far away the linear solvers find the pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from benchmarks.experiments import charts
from benchmarks.experiments import methods as m
from benchmarks.experiments.errors import ORIENTATION, motion_errors
from benchmarks.experiments.methods import available, estimate
from benchmarks.experiments.results import Claim, Context, Statement, Table
from benchmarks.experiments.trials import Setting, draw_trials, random_rotations
from rs_localizer.core.arrays import Array

BASIN = Setting(angular=20.0, linear=0.2)
FOUND = 2.0  # deg of orientation error
_OFFSETS = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 60.0, 75.0, 90.0)
_METHODS = (m.R6P, replace(m.VCWT, iterations=10), replace(m.VCWT_OURS, iterations=10))


def basin_shares(context: Context) -> dict[str, Array]:
    """Share of the frames that each method finds, by the error of the initial orientation."""
    trials = draw_trials(context.trials, context.seed, BASIN)
    methods = available(_METHODS)
    shares: dict[str, list[float]] = {method.name: [] for method in methods}
    for offset in context.track(_OFFSETS, len(_OFFSETS)):
        turn = random_rotations(len(trials), context.seed, offset)
        for method in methods:
            found = estimate(method, trials, turn @ trials.truth.rotation)
            error = motion_errors(found, trials.truth)[:, ORIENTATION]
            shares[method.name].append(float(np.mean(error < FOUND)))
    return {name: np.array(values) for name, values in shares.items()}


def basin_table(basin: Mapping[str, Array]) -> Table:
    """The shares as a table."""
    rows = [
        (offset, name, float(share))
        for name, shares in basin.items()
        for offset, share in zip(_OFFSETS, shares, strict=True)
    ]
    return Table(("initial_error_deg", "method", "found"), rows)


def reach(basin: Mapping[str, Array], offset: float, most: float) -> Claim:
    """Whether relinearizing, and only that, reaches so far; frozen finds ``most`` at most."""
    at = _OFFSETS.index(offset)
    ours, frozen = (float(basin[x.name][at]) for x in (m.VCWT_OURS, m.VCWT))
    start = float(basin[m.VCWT_OURS.name][0])
    return Statement(
        f"convergence.basin_{offset:g}",
        "this project",
        f"relinearized, {m.VCWT.label} converges from {offset:g} degrees, frozen it does not",
        f"at least 95 % of the frames that are found from the truth itself; frozen at most "
        f"{most:.0%} of all",
    ).judged(
        f"{ours:.0%} and {frozen:.1%} of all frames ({start:.0%} from the truth itself)",
        ours >= 0.95 * start and frozen <= most,
    )


def basin_figure(basin: Mapping[str, Array]) -> Figure:
    """The shares over the initial error."""
    drawn = charts.figure(6.4, 4.4)
    axes = drawn.subplots()
    for method in available(_METHODS):
        shares = 100.0 * basin[method.name]
        charts.line(axes, np.array(_OFFSETS), shares, charts.look(method), method.label)
    axes.set_ylim(-3.0, 103.0)
    charts.tidy(axes, "error of the initial orientation (deg)", "frames found (%)")
    axes.legend(frameon=False)
    return drawn
