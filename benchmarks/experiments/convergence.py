# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How many iterations the solvers need: the paper's Fig. 3."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.experiments import methods as m
from benchmarks.experiments.methods import Method
from benchmarks.experiments.results import Claim, Context, Result, Table, limited
from benchmarks.experiments.sweeps import ORIENTATION, POSE, Curves, motion_errors, sweep
from benchmarks.experiments.trials import Motions, Setting, Trials, draw_trials
from rs_localizer.core.arrays import Array

_SPEEDS = (0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 20.0, 25.0, 30.0)  # deg per frame
_TRANSLATION = 0.01  # per degree
_COUNTS = (1, 5, 50)
_STEPS = (1, 2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 50)
_LINEAR = (*m.TWO_STEP, m.VCWT)
_METHODS = (m.R6P, *_LINEAR)
_MOVING = Setting(15.0, 15.0 * _TRANSLATION)
# P3P as of the best triplet; r9p as published has a gauge at rest.
_AT_REST = (m.P3P, *_METHODS, m.VCWT_OURS, m.R9P_OURS, m.JOINT)
_DRIFTING = (m.R6P, m.VCT_W, m.VCT_WT, m.VCWT, m.VCWT_OURS, m.R9P, m.R9P_OURS, m.JOINT)
_EXACT = 1e-6  # deg; relative: rounding, far below anything that a wrong coefficient leaves
_SIX = 6


def run(context: Context) -> Result:
    """Motion as under ``motion``, without noise, after 1, 5 and 50 iterations from the truth.

    And the error of the twelve equations of ``(I + r[w]x)(I + [v]x) X + C + r t`` themselves (root
    of the sum of squares, bearings) at 15 degrees per frame. ``r6p`` does not iterate.
    """
    by_count = {
        count: sweep(
            context, _SPEEDS,
            lambda speed: Setting(speed, _TRANSLATION * speed),
            [replace(method, iterations=count) for method in _METHODS],
        )
        for count in _COUNTS
    }  # fmt: skip
    trials = draw_trials(context.trials, context.seed, _MOVING)
    algebraic = {method.name: _algebraic(method, trials) for method in _LINEAR}
    once, fifty = by_count[1], by_count[50]
    chosen = [_STEPS.index(count) for count in (1, 2, 5, 8, 20, 50)]
    heading = ("algebraic error, iterations:", *(str(_STEPS[k]) for k in chosen))
    shown = Table(
        heading, [(name, *(f"{of[k]:.0e}" for k in chosen)) for name, of in algebraic.items()]
    )
    falls = np.array([np.diff(algebraic[method.name]) for method in m.TWO_STEP])
    slow = [_over(fifty, once, method, m.VCWT)[2:] for method in m.TWO_STEP]
    return Result(
        [
            *exactness(context),
            limited(
                "convergence.vcwt_once",
                "paper: one iteration of r6p_vcwt is nearly enough",
                "its pose errors after 1 over those after 50, medians",
                _over(once, fifty, m.VCWT), most=1.1,
            ),
            limited(
                "convergence.two_step_slow",
                "paper: the solvers in two steps need many iterations and stay worse",
                "their pose errors after 50 over those of r6p_vcwt after 1, medians from 9 deg on",
                np.ravel(slow), least=1.0,
            ),
            limited(
                "convergence.two_step_falls",
                "each iteration of the solvers in two steps lowers the algebraic error",
                "largest rise from one number of iterations to the next", np.max(falls).item(),
                most=0.0,
            ),
            limited(
                "convergence.two_step_solves",
                "and 50 of them take most of it away",
                "algebraic error after 50 over that after 1",
                [algebraic[x.name][-1] / algebraic[x.name][0] for x in m.TWO_STEP], most=0.2,
            ),
        ],
        [_shown(by_count), shown.text()],
    )  # fmt: skip


def exactness(context: Context) -> list[Claim]:
    """What is true of right equations to rounding, and of no others: each solver is in one."""
    rest, drift, moving = (
        draw_trials(context.trials, context.seed, setting)
        for setting in (Setting(), Setting(linear=0.1, drifting=True), _MOVING)
    )
    at_rest = [
        np.median(motion_errors(m.estimate(method, rest), rest.truth)[:, POSE], axis=0)
        for method in _AT_REST
    ]
    drifting = [
        np.median(motion_errors(m.estimate(method, drift), drift.truth), axis=0)
        for method in _DRIFTING
    ]
    solved = m.estimate(replace(m.VCWT, iterations=8), moving)
    return [
        limited(
            "convergence.exact_at_rest", "without motion and noise every solver's pose is exact",
            "largest median error", np.max(at_rest).item(), most=_EXACT,
        ),
        limited(
            "convergence.exact_in_translation",
            "while the scene drifts straight all but P3P and r6p_vc_wt are exact, velocities, too",
            "largest median error, without noise", np.max(drifting).item(), most=_EXACT,
        ),
        limited(
            "convergence.vcwt_solves",
            "r6p_vcwt solves its equations: after 8 iterations nothing but rounding is left",
            "algebraic error at 15 deg per frame, median",
            float(np.median(algebraic_errors(solved, moving))), most=1e-9,
        ),
        limited(
            "convergence.least_squares",
            "the last step of the solvers in two steps leaves least squares of its unknowns",
            "cosine between the error of the equations and what w (and t) can change, median",
            [_steepness(method, moving) for method in m.TWO_STEP], most=_EXACT,
        ),
    ]  # fmt: skip


def _algebraic(method: Method, trials: Trials) -> Array:
    """Median algebraic errors after each of ``_STEPS`` iterations."""
    found = [m.estimate(replace(method, iterations=count), trials) for count in _STEPS]
    return np.array([np.median(algebraic_errors(motions, trials)) for motions in found])


def _steepness(method: Method, trials: Trials) -> float:
    """Largest cosine between the equations' errors and the columns of w, and of t, median."""
    found = m.estimate(method, trials)
    errors, columns = _missed(found, trials), []
    for name in ("w", "t")[: 1 if method is m.VCT_W else 2]:
        for unit in np.eye(3):
            moved = replace(found, **{name: getattr(found, name) + unit})
            columns.append(_missed(moved, trials) - errors)  # linear in both
    slopes = np.array(columns)
    along = np.abs(np.einsum("khe,he->kh", slopes, errors))
    along /= np.linalg.norm(slopes, axis=2) * np.linalg.norm(errors, axis=1)
    return float(np.median(along.max(axis=0)))


def algebraic_errors(found: Motions, trials: Trials) -> Array:
    """How far (h,) motions are from solving the equations of their six points."""
    return np.asarray(np.linalg.norm(_missed(found, trials), axis=1))


def _missed(found: Motions, trials: Trials) -> Array:
    """Errors (h,12) of the equations of six points, written anew.

    The solvers return the rotation nearest to ``I + [v]x``, by ``atan |v|`` about ``v`` from the
    initial rotation, here the true one: ``v`` is had back from it.
    """
    turn = Rotation.from_matrix(found.rotation @ np.swapaxes(trials.truth.rotation, 1, 2))
    vector = turn.as_rotvec()
    angle = np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-15)
    v = np.tan(angle) / angle * vector
    x = np.einsum("hij,hnj->hni", trials.truth.rotation, trials.points[:, :_SIX])
    tau = trials.tau[:, :_SIX, None]
    turned = x + np.cross(v[:, None], x)
    local = turned + tau * np.cross(found.w[:, None], turned)
    local += found.translation[:, None] + tau * found.t[:, None]
    missed = trials.rays[:, :_SIX] * local[..., 2:] - local[..., :2]
    return np.asarray(missed.reshape(len(trials), -1))


def _over(
    one: Curves, other: Curves, method: Method, of_other: Method | None = None
) -> list[float]:
    """Ratios of pose errors, the larger of orientation and position, while something moves."""
    ratios = one.moving(method)[:, POSE] / other.moving(of_other or method)[:, POSE]
    return [float(value) for value in ratios.max(axis=1)]


def _shown(by_count: dict[int, Curves]) -> str:
    places = [_SPEEDS.index(speed) for speed in (6.0, 15.0, 30.0)]
    rows = []
    for count, curves in by_count.items():
        for method in _METHODS:
            if method is m.R6P and count > 1:
                continue
            errors = curves.medians(method)[places, ORIENTATION]
            shown = (f"{error:.2g}" for error in errors)
            rows.append((method.name, "" if method is m.R6P else count, *shown))
    return Table(("Fig. 3: orientation (deg), motion:", "iterations", "6 deg", "15 deg", "30 deg"),
                 rows).text()  # fmt: skip
