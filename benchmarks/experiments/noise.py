# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors under pixel noise, how near they come to the bound, and what six points can see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.experiments import charts
from benchmarks.experiments import methods as m
from benchmarks.experiments.charts import Look
from benchmarks.experiments.errors import ORIENTATION, motion_errors
from benchmarks.experiments.kernels import frame_errors, informations
from benchmarks.experiments.methods import Method, states, view_arguments
from benchmarks.experiments.results import Claim, Context, Result, Statement, Table
from benchmarks.experiments.sweeps import Curves, sampled, sweep
from benchmarks.experiments.trials import POINTS, Setting, Trials, draw_trials
from benchmarks.experiments.uncertainty import share
from rs_localizer.core.arrays import Array


def median_bound(trials: Trials, points: int, noise: float, seed: int) -> Array:
    """Medians (2,) of the orientation (deg) and relative position error of the bound.

    Errors are drawn from the normal distribution whose covariance is the inverse Fisher
    information of the first so many points at the true motion.

    Args:
        noise: px.
    """
    world, rays, tau, by_ray, mounts = view_arguments(trials)
    information = informations(
        states(trials.truth), _first(world, points), _first(rays, points), _first(tau, points),
        by_ray[:points], mounts,
    )  # fmt: skip
    scale = 1.0 / np.sqrt(np.einsum("hii->hi", information))
    scaled = information * scale[:, :, None] * scale[:, None, :]
    values, vectors = np.linalg.eigh(scaled)
    half = scale[:, :, None] * vectors / np.sqrt(np.maximum(values, 1e-15))[:, None, :]
    draws = np.random.default_rng([seed, 2]).normal(size=(len(trials), half.shape[2]))
    errors = noise * np.einsum("hij,hj->hi", half, draws)
    distance = np.linalg.norm(trials.truth.position, axis=1)
    return np.array(
        [
            np.median(np.degrees(np.linalg.norm(errors[:, 0:3], axis=1))),
            np.median(np.linalg.norm(errors[:, 3:6], axis=1) / distance),
        ]
    )


def _first(values: Array, points: int) -> Array:
    return np.ascontiguousarray(values[:, :points])


_NOISES = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
_SPEED, _TRANSLATION = 20.0, 0.2  # deg and units per frame
_X_LABEL = "noise (px)"
_ALIKE = 2.0
_RADII = (2.0, 4.0, 8.0)
_FEW = (0.20, 0.45, 0.75)
_SIX = 6
_BOUNDS = (Look("#707070", "", "--", 2.0), Look("#707070", "", ":", 2.0))


def run(context: Context) -> Result:
    """The experiment."""
    curves = sweep(
        context, "noise_px", _NOISES, lambda noise: Setting(_SPEED, _TRANSLATION, noise), m.ALL
    )
    trials = draw_trials(context.trials, context.seed, Setting(_SPEED, _TRANSLATION, 1.0))
    bounds = {n: median_bound(trials, n, 1.0, context.seed) for n in (_SIX, POINTS)}
    shares = _visible_shares(trials)
    table = Table(
        ("points", "orientation_deg", "position"),
        [(n, *map(float, bound)) for n, bound in bounds.items()],
    )
    return Result(
        "Noise",
        f"Noise up to 4 px on a 1000 px image while the camera turns by {_SPEED:g} degrees and "
        f"moves by {_TRANSLATION:g} per frame; everything else as under Motion. The bound is that "
        "of Cramer and Rao.",
        [
            _alike("noise.all_alike", "all rolling-shutter solvers", m.PAPERS[1:], curves),
            _alike("noise.joint_solvers_alike", "R6P, R6P v,C,w,t and R9P", (m.R6P, m.R9P), curves),
            _six_points(curves, bounds[_SIX]),
            _fifty_points(curves, bounds[POINTS]),
            _visible(shares),
            _one_sample(trials, bounds[POINTS]),
        ],
        {"noise": curves.table(), "noise_bound": table},
        {"noise": _figure(curves, bounds)},
    )


def _slope(curves: Curves, method: Method) -> float:
    """Growth of the median orientation error per px over the upper half of the noises."""
    error = curves.median(method, ORIENTATION)
    half = len(error) // 2
    return float((error[-1] - error[half]) / (curves.x[-1] - curves.x[half]))


def _alike(name: str, who: str, methods: Sequence[Method], curves: Curves) -> Claim:
    reference = _slope(curves, m.VCWT)
    slopes = {
        x: sampled(lambda drawn, x=x: _slope(drawn, x) / _slope(drawn, m.VCWT), curves)
        for x in methods
        if curves.has(x)
    }
    listed = ", ".join(f"{x.label} {slope.value * reference:.2f}" for x, slope in slopes.items())
    return Statement(
        name,
        "paper: noise",
        f"{who} degrade alike",
        "from 2 to 4 px, median orientation errors grow per px by half to twice as much as that of "
        f"{m.VCWT.label}",
    ).judged_by(
        f"{m.VCWT.label} {reference:.2f} deg per px; {listed}",
        list(slopes.values()),
        (1.0 / _ALIKE, _ALIKE),
        "the solvers in two steps stop near their start, w = t = 0: after five iterations a bias "
        "of degrees hides the noise, so that their curves start high and stay flat (see "
        "convergence.others_slow)",
    )


def _six_points(curves: Curves, bound: Array) -> Claim:
    found = {
        x.label: sampled(lambda drawn, x=x: drawn.at(x, ORIENTATION, 1.0), curves)
        for x in (m.R6P, m.VCWT)
        if curves.has(x)
    }
    listed = ", ".join(f"{label} {error.value:.2f}" for label, error in found.items())
    return Statement(
        "noise.six_point_bound",
        "this project",
        "a six-point pose is limited by the noise, not by the solver",
        "median orientation error at 1 px at most 1.5 times the bound of six points",
    ).judged_by(
        f"{listed} deg; bound {bound[0]:.2f}", list(found.values()), (-np.inf, 1.5 * bound[0])
    )


def _fifty_points(curves: Curves, bound: Array) -> Claim:
    error = sampled(lambda drawn: drawn.at(m.REFINED, ORIENTATION, 1.0), curves)
    return Statement(
        "noise.refined_reaches_bound",
        "this project",
        f"refined on all {POINTS} points, the pose is as good as it can be",
        f"median orientation error at 1 px at most 1.15 times the bound of {POINTS} points",
    ).judged_by(
        f"{error.value:.4f} deg; bound {bound[0]:.4f}; six-point start "
        f"{curves.at(m.VCWT_OURS, ORIENTATION, 1.0):.2f}",
        [error],
        (-np.inf, 1.15 * bound[0]),
    )


def _visible_shares(trials: Trials) -> list[float]:
    """Shares of the points outside the sample within each radius of a six-point model."""
    states = m.states(m.estimate(m.VCWT_OURS, trials))
    errors = frame_errors(states, *m.view_arguments(trials))[:, _SIX:]
    return [float(np.mean(errors < radius)) for radius in _RADII]


def _visible(shares: Sequence[float]) -> Claim:
    return Statement(
        "noise.few_inliers_seen",
        "this project",
        "a six-point model of inliers alone sees few of the others (13, 38, 67 % within 2, 4, 8 px "
        "in a pilot): counting its inliers tells little",
        "at 1 px noise, fewer than "
        + ", ".join(
            f"{few:.0%} within {radius:g} px" for few, radius in zip(_FEW, _RADII, strict=True)
        ),
    ).judged(
        ", ".join(
            f"{seen:.0%} within {radius:g} px" for seen, radius in zip(shares, _RADII, strict=True)
        ),
        all(seen < few for seen, few in zip(shares, _FEW, strict=True)),
    )


def _one_sample(trials: Trials, bound: Array) -> Claim:
    found = motion_errors(m.estimate(m.REFINED, trials, noise=1.0), trials.truth)
    succeeded = share(found[:, ORIENTATION] < 10.0 * bound[0])
    return Statement(
        "noise.one_sample_suffices",
        "this project",
        "local optimisation from one sample of inliers alone succeeds in 99 to 100 %",
        "at 1 px, 98 % of the refined orientations within ten times the median bound",
    ).judged_by(
        succeeded.share(),
        [succeeded],
        (0.98, 1.0),
        "six points that happen to determine the motion badly (most of them in the worst tenth by "
        "their own bound) start it where half of the points miss by more than the widest "
        "threshold, 16 px; the robust loop optimises the best two of every block of samples",
    )


def _figure(curves: Curves, bounds: Mapping[int, Array]) -> Figure:
    def draw_bounds(axes: Axes, metric: int) -> None:
        for n, (style, bound) in enumerate(zip(_BOUNDS, bounds.values(), strict=True)):
            if metric < len(bound):
                label = f"bound, {list(bounds)[n]} points"
                charts.line(axes, curves.x[1:], curves.x[1:] * bound[metric], style, label)

    return charts.error_figure(
        curves, (*m.PAPERS, m.REFINED), _X_LABEL, skip_zero=False, decorate=draw_bounds
    )
