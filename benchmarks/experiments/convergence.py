# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How many iterations the linear solvers need, and from how far they converge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from benchmarks.experiments import charts
from benchmarks.experiments import methods as m
from benchmarks.experiments.methods import Method, estimate
from benchmarks.experiments.motion import SPEEDS, TRANSLATION
from benchmarks.experiments.results import Claim, Context, Result, Table, limited
from benchmarks.experiments.sweeps import (
    METRICS,
    ORIENTATION,
    POSE,
    motion_errors,
    quartiles,
    sweep,
)
from benchmarks.experiments.trials import Motions, Setting, Trials, draw_trials, random_rotations
from rs_localizer.core.arrays import Array

_BASIN = Setting(angular=20.0, linear=0.2)
_FOUND = 2.0  # deg of orientation error
_OFFSETS = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 60.0, 75.0, 90.0)
_FAR = (m.R6P, replace(m.VCWT, iterations=10), replace(m.VCWT_OURS, iterations=10))

_ITERATIVE = (m.VC_WT, m.VCT_W, m.VCT_WT, m.VCWT)
_ITERATIONS = (1, 2, 3, 4, 5, 6, 8, 10, 14, 20, 30, 50)
_SHOWN = (1, 5, 50)
_FLAT_FROM = 8
_SETTING = Setting(angular=15.0, linear=0.15)


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
    once, settled = after[1].moving(m.VCWT), after[50].moving(m.VCWT)
    slow = [after[50].moving(x)[:, POSE] for x in m.TWO_STEP]
    worse = [one / once[:, POSE] for one in slow]
    gain = [after[5].moving(x)[:, POSE] / one for x, one in zip(m.TWO_STEP, slow, strict=True)]
    trials = draw_trials(context.trials, context.seed, _SETTING)
    history = {
        method: np.array([_medians(replace(method, iterations=n), trials) for n in _ITERATIONS])
        for method in _ITERATIVE
    }
    at, floor = _ITERATIONS.index(_FLAT_FROM), 1e-12
    falls = [(rows[at, 2] + floor) / (rows[-1, 2] + floor) for rows in history.values()]
    basin = _basin_shares(context)
    return Result(
        "Convergence",
        "Motion as in the experiment of that name, without noise, from the true orientation, with "
        f"1, 5 and 50 iterations; iteration by iteration at {_SETTING.angular:g} degrees and "
        f"{_SETTING.linear:g} per frame, with the algebraic error: the root mean square of the "
        "twelve equations. And the share of frames that are found, to "
        f"{_FOUND:g} degrees, from an initial orientation so far from the truth, after ten "
        f"iterations, at {_BASIN.angular:g} degrees and {_BASIN.linear:g} per frame.",
        [
            limited(
                "convergence.vcwt_once", f"paper: {m.VCWT.label} is done after one iteration",
                "medians after one iteration over those after 50", np.max(once / settled).item(),
                most=1.05,
            ),
            limited(
                "convergence.others_slow",
                "paper: the solvers in two steps need many iterations and stay worse",
                f"medians of the pose after 50 iterations over those of {m.VCWT.label} after one; "
                "those after 5 over those after 50", [np.min(worse), np.min(gain)], least=1.0,
            ),
            limited(
                "convergence.flat_after_eight",
                "paper: the algebraic error is flat after about eight iterations",
                "its median after 8 iterations over that after 50", falls, most=1.5,
                why="alternation between two groups of unknowns converges linearly: on a "
                "logarithmic axis the curves of the solvers in two steps go on falling",
            ),
            *(
                claim
                for offset, most in ((30.0, 0.15), (60.0, 0.02))
                for claim in _reach(basin, offset, most)
            ),
        ],
        {
            "convergence": Table(
                ("iterations", "method", "orientation_deg", "position", "algebraic"),
                [
                    (count, method.name, *map(float, row))
                    for method, rows in history.items()
                    for count, row in zip(_ITERATIONS, rows, strict=True)
                ],
            ),
            **{f"convergence_motion_{count}": curves.table() for count, curves in after.items()},
            "convergence_basin": Table(
                ("initial_error_deg", "method", "found"),
                [
                    (offset, method.name, float(share))
                    for method, shares in basin.items()
                    for offset, share in zip(_OFFSETS, shares, strict=True)
                ],
            ),
        },
        {"convergence": _figure(history, basin)},
    )  # fmt: skip


def _basin_shares(context: Context) -> dict[Method, Array]:
    """Share of the frames that each method finds, by the error of the initial orientation."""
    trials = draw_trials(context.trials, context.seed, _BASIN)
    shares: dict[Method, list[float]] = {method: [] for method in _FAR}
    for offset in context.track(_OFFSETS, len(_OFFSETS)):
        turn = random_rotations(len(trials), context.seed, offset)
        for method in _FAR:
            found = estimate(method, trials, turn @ trials.truth.rotation)
            error = motion_errors(found, trials.truth)[:, ORIENTATION]
            shares[method].append(float(np.mean(error < _FOUND)))
    return {method: np.array(values) for method, values in shares.items()}


def _reach(basin: Mapping[Method, Array], offset: float, most: float) -> list[Claim]:
    """Whether relinearizing, and only that, reaches so far; frozen finds ``most`` at most."""
    at = _OFFSETS.index(offset)
    _, frozen, ours = basin.values()
    return [
        limited(
            f"convergence.basin_{offset:g}",
            f"relinearized, {m.VCWT.label} converges from {offset:g} degrees",
            "share of the frames that are found from the truth itself", ours[at] / ours[0],
            least=0.95,
        ),
        limited(
            f"convergence.basin_{offset:g}_frozen", "frozen it does not",
            "share of the frames that are found", float(frozen[at]), most=most,
        ),
    ]  # fmt: skip


def _algebraic_errors(found: Motions, trials: Trials, initial: Array) -> Array:
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
    orientation, position, *_ = quartiles(motion_errors(found, trials.truth))[1].tolist()
    algebraic = np.nanmedian(_algebraic_errors(found, trials, trials.truth.rotation))
    return orientation, position, float(algebraic)


def _figure(history: Mapping[Method, Array], basin: Mapping[Method, Array]) -> Figure:
    drawn = charts.figure(12.0, 8.0)
    *panels, last = drawn.subplots(2, 2).ravel()
    labels = [*list(METRICS.values())[:2], "algebraic error (rms)"]
    for k, (axes, label) in enumerate(zip(panels, labels, strict=True)):
        for method, rows in history.items():
            # What is left of vcwt's equations is rounding: it would stretch the axis.
            charts.line(axes, np.array(_ITERATIONS), np.maximum(rows[:, k], 1e-7), method)
        axes.set_xscale("log")
        charts.tidy(axes, "iterations", label, logarithmic=True)
    charts.legend(drawn, panels[0])
    for method, shares in basin.items():
        charts.line(last, np.array(_OFFSETS), 100.0 * shares, method)
    charts.tidy(last, "error of the initial orientation (deg)", "frames found (%)")
    last.legend(frameon=False)
    return drawn
