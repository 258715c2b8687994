# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How many iterations the linear solvers need."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from benchmarks.experiments import charts
from benchmarks.experiments import methods as m
from benchmarks.experiments.errors import METRICS, ORIENTATION, POSITION, motion_errors
from benchmarks.experiments.methods import Method, available, estimate
from benchmarks.experiments.motion import SPEEDS, TRANSLATION, X_LABEL
from benchmarks.experiments.results import Claim, Context, Result, Statement, Table
from benchmarks.experiments.sweeps import Curves, quartiles, sweep
from benchmarks.experiments.trials import Motions, Setting, Trials, draw_trials, random_rotations
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


_ITERATIVE = (m.VC_WT, m.VCT_W, m.VCT_WT, m.VCWT)
_ITERATIONS = (1, 2, 3, 4, 5, 6, 8, 10, 14, 20, 30, 50)
_SHOWN = (1, 5, 50)
_FLAT_FROM = 8
_SETTING = Setting(angular=15.0, linear=0.15)
_POSE = 2  # the first metrics are those of the pose
_PAPER = "paper: convergence"


def run(context: Context) -> Result:
    """The experiment."""
    after = {
        count: sweep(
            context, "deg_per_frame", SPEEDS,
            lambda speed: Setting(speed, TRANSLATION * speed),
            [replace(method, iterations=count) for method in _ITERATIVE],
        )
        for count in _SHOWN
    }  # fmt: skip
    trials = draw_trials(context.trials, context.seed, _SETTING)
    history = {
        method.name: np.array(
            [_medians(replace(method, iterations=count), trials) for count in _ITERATIONS]
        )
        for method in _ITERATIVE
    }
    basin = basin_shares(context)
    return Result(
        "Convergence",
        "Motion as in the experiment of that name, without noise, from the true orientation, with "
        f"1, 5 and 50 iterations; iteration by iteration at {_SETTING.angular:g} degrees and "
        f"{_SETTING.linear:g} per frame, with the algebraic error: the root mean square of the "
        "twelve equations. And the share of frames that are found, to "
        f"{FOUND:g} degrees, from an initial orientation so far from the truth, after ten "
        f"iterations, at {BASIN.angular:g} degrees and {BASIN.linear:g} per frame.",
        [
            _once_is_enough(after),
            _others_slow(after),
            _flat(history),
            reach(basin, 30.0, 0.15),
            reach(basin, 60.0, 0.02),
        ],
        {
            "convergence": Table(
                ("iterations", "method", "orientation_deg", "position", "algebraic"),
                [
                    (count, name, *map(float, row))
                    for name, rows in history.items()
                    for count, row in zip(_ITERATIONS, rows, strict=True)
                ],
            ),
            **{f"convergence_motion_{count}": curves.table() for count, curves in after.items()},
            "convergence_basin": basin_table(basin),
        },
        {
            "convergence": _history_figure(history),
            "convergence_motion": _motion_figure(after),
            "convergence_basin": basin_figure(basin),
        },
    )


def algebraic_errors(found: Motions, trials: Trials, initial: Array) -> Array:
    """Root mean square (h,) of the equations of the first six points in the solvers' model.

    ``(-1, 0, a)`` and ``(0, -1, b)`` times ``(I + r [w]x)(I + [v]x) R0 X + C + r t``, where v is
    that of the rotation by ``atan |v|`` about it which leads from R0 to the solution.
    """
    turn = found.rotation @ np.swapaxes(initial, 1, 2)
    skew = 0.5 * (turn - np.swapaxes(turn, 1, 2))
    cosine = 0.5 * (np.einsum("hii->h", turn) - 1.0)
    v = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1) / cosine[:, None]
    points, rays, tau = trials.points[:, :6], trials.rays[:, :6], trials.tau[:, :6, None]
    start = np.einsum("hij,hnj->hni", initial, points)
    turned = start + np.cross(v[:, None], start)
    seen = turned + tau * np.cross(found.w[:, None], turned)
    seen += found.translation[:, None] + tau * found.t[:, None]
    residuals = rays * seen[..., 2:] - seen[..., :2]
    return np.asarray(np.sqrt(np.mean(residuals**2, axis=(1, 2))))


def _medians(method: Method, trials: Trials) -> tuple[float, float, float]:
    found = estimate(method, trials)
    errors = quartiles(motion_errors(found, trials.truth))[1]
    algebraic = np.nanmedian(algebraic_errors(found, trials, trials.truth.rotation))
    return float(errors[ORIENTATION]), float(errors[POSITION]), float(algebraic)


def _once_is_enough(after: Mapping[int, Curves]) -> Claim:
    once, often = (after[count].medians(m.VCWT)[1:] for count in (_SHOWN[0], _SHOWN[-1]))
    excess = float(np.max(once / often)) - 1.0
    return Statement(
        "convergence.vcwt_once",
        _PAPER,
        f"{m.VCWT.label} is done after one iteration",
        f"all medians after one iteration at most 5 % above those after {_SHOWN[-1]}, wherever it "
        "moves",
    ).judged(f"at most {excess:+.1%}", excess <= 0.05)


def _others_slow(after: Mapping[int, Curves]) -> Claim:
    once = after[1].medians(m.VCWT)[1:, :_POSE]
    worse = min(
        float(np.min(after[_SHOWN[-1]].medians(method)[1:, :_POSE] / once)) for method in m.TWO_STEP
    )
    gain = min(
        float(np.min(after[5].medians(method)[1:, :_POSE]
                     / after[_SHOWN[-1]].medians(method)[1:, :_POSE]))
        for method in m.TWO_STEP
    )  # fmt: skip
    return Statement(
        "convergence.others_slow",
        _PAPER,
        "the solvers in two steps need many iterations and stay worse",
        f"wherever it moves, their medians of orientation and position after {_SHOWN[-1]} "
        f"iterations are still above those of {m.VCWT.label} after one, and below theirs after 5",
    ).judged(
        f"at least {worse:.1f} times those of {m.VCWT.label}; from 5 to {_SHOWN[-1]} iterations "
        f"they fall to 1/{gain:.1f} or less",
        worse > 1.0 and gain > 1.0,
    )


def _flat(history: Mapping[str, Array]) -> Claim:
    at = _ITERATIONS.index(_FLAT_FROM)
    floor = 1e-12
    falls = {
        method.label: float((history[method.name][at, 2] + floor)
                            / (history[method.name][-1, 2] + floor))
        for method in _ITERATIVE
    }  # fmt: skip
    listed = ", ".join(f"{label} {fall:.2g}" for label, fall in falls.items())
    return Statement(
        "convergence.flat_after_eight",
        _PAPER,
        "the algebraic error is flat after about eight iterations",
        f"its median after {_FLAT_FROM} iterations at most 1.5 times that after {_SHOWN[-1]}",
    ).judged(
        f"times {listed}",
        all(fall <= 1.5 for fall in falls.values()),
        "alternation between two groups of unknowns converges linearly: the curves of the solvers "
        "in two steps look flat on a linear axis, on a logarithmic one they go on falling, and "
        "the pose with them",
    )


def _history_figure(history: Mapping[str, Array]) -> Figure:
    drawn = charts.figure(12.0, 4.4)
    labels = (METRICS[ORIENTATION].label, METRICS[POSITION].label, "algebraic error (rms)")
    panels = drawn.subplots(1, 3)
    for k, (axes, label) in enumerate(zip(panels, labels, strict=True)):
        for method in _ITERATIVE:
            y = history[method.name][:, k]
            # What is left of vcwt's equations is rounding: it would stretch the axis.
            y = np.maximum(y, 1e-7) if k == 2 else y
            charts.line(axes, np.array(_ITERATIONS), y, charts.look(method), method.label)
        axes.set_xscale("log")
        charts.plain_logarithmic(axes)
        axes.set_xticks(_ITERATIONS[::2], labels=[str(i) for i in _ITERATIONS[::2]])
        axes.minorticks_off()
        charts.tidy(axes, "iterations", label)
    charts.legend(drawn, panels[0])
    return drawn


def _motion_figure(after: Mapping[int, Curves]) -> Figure:
    drawn = charts.figure(12.0, 4.4)
    panels = drawn.subplots(1, len(after), sharey=True)
    for axes, (count, curves) in zip(panels, after.items(), strict=True):
        for method in _ITERATIVE:
            y = curves.median(method, ORIENTATION)[1:]
            charts.line(axes, curves.x[1:], y, charts.look(method), method.label)
        axes.set_title(f"{count} iteration{'s' if count > 1 else ''}")
        charts.tidy(axes, X_LABEL.split(";")[0], "")
    panels[0].set_ylabel(METRICS[ORIENTATION].label)
    charts.plain_logarithmic(panels[0])
    charts.legend(drawn, panels[0])
    return drawn
