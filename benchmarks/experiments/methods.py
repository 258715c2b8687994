# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The methods that are compared, and how each gets its estimate from a frame.

Solvers with several solutions: the one with the least robust score over all points of the frame
is taken, as a robust loop would. P3P alone gets the best of all triplets of the six points, as in
the paper: the pose whose orientation is nearest to the truth, which no real method could pick.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from benchmarks.experiments.trials import POINTS, Motions, Trials, angles, camera
from rs_localizer.config import LocalizerConfig
from rs_localizer.core.arrays import Array
from rs_localizer.core.rig import Mounts, Rig
from rs_localizer.core.state import STATE_SIZE
from rs_localizer.estimation.points import Observations
from rs_localizer.estimation.prior import assumptions
from rs_localizer.estimation.robust import EXPECTED_NOISE, refine
from rs_localizer.estimation.search import SCORE_SCALE, optimize
from rs_localizer.solvers.minimal import solve_minimal
from rs_localizer.solvers.table import find_solver

_SIX = 6
_TRIPLETS = np.array(list(combinations(range(_SIX), 3)))


@dataclass(frozen=True, slots=True)
class Method:
    """A row of the tables and a line of the figures; labels begin with the setting ``solver``."""

    name: str
    label: str
    solver: str
    iterations: int = 5
    as_published: bool = True
    refined: bool = False


PAPERS = P3P, R6P, VC_WT, VCT_W, VCT_WT, VCWT, R9P = tuple(
    Method(name, name, name)
    for name in ("p3p", "r6p", "r6p_vc_wt", "r6p_vct_w", "r6p_vct_wt", "r6p_vcwt", "r9p")
)
VCWT_OURS = Method("r6p_vcwt_relinearized", "r6p_vcwt, relinearized", "r6p_vcwt",
                   as_published=False)  # fmt: skip
R9P_OURS = Method("r9p_trace_fixed", "r9p, trace fixed", "r9p", as_published=False)
JOINT = Method("joint", "joint", "joint", as_published=False)
REFINED = Method("refined", f"ours, refined on {POINTS} points", "r6p_vcwt", as_published=False,
                 refined=True)  # fmt: skip

TWO_STEP = (VC_WT, VCT_W, VCT_WT)
OURS = (VCWT_OURS, R9P_OURS, JOINT, REFINED)
ALL = PAPERS + OURS


def estimate(
    method: Method, trials: Trials, initial: Array | None = None, noise: float = 0.0
) -> Motions:
    """Estimates of all frames; NaN where there is none.

    Args:
        initial: initial rotations (h,3,3); the true ones by default.
        noise: px, by which a user would choose the inlier threshold.
    """
    if method.solver == "p3p":
        return best_triplet(trials)
    models = _models(method, trials, trials.truth.rotation if initial is None else initial)
    threshold = LocalizerConfig().inlier_threshold * max(1.0, noise)
    if models.shape[1] > 1:
        return _best(models, trials, SCORE_SCALE * threshold)
    if method.refined:
        return _refined(models[:, 0], trials, threshold)
    return _motions(models[:, 0])


def best_triplet(trials: Trials) -> Motions:
    """P3P's pose of any three of the first six points, nearest to the true orientation."""
    models = _triplet_models(trials)
    apart = angles(models[:, :, :9].reshape(*models.shape[:2], 3, 3),
                   trials.truth.rotation[:, None])  # fmt: skip
    best = np.argmin(np.where(np.isnan(apart), np.inf, apart), axis=1)
    return _motions(models[np.arange(len(models)), best])


def states(motions: Motions) -> Array:
    """Model B states (h,24) of the reprojection kernels: ``omega = -w``, ``v = w x C - t``."""
    parts = motions.rotation.reshape(-1, 9), motions.translation, motions.w, motions.t
    return _states(np.hstack(parts))


def _models(method: Method, trials: Trials, initial: Array) -> Array:
    n = find_solver(method.solver).sample_size
    solutions = solve_minimal(
        method.solver, trials.points[:, :n], trials.rays[:, :n], trials.tau[:, :n], initial,
        method.iterations, method.as_published,
    )  # fmt: skip
    return _stacked(solutions)


def _triplet_models(trials: Trials) -> Array:
    points, rays, tau = (of[:, _TRIPLETS] for of in (trials.points, trials.rays, trials.tau))
    models = _stacked(solve_minimal(
        "p3p", points.reshape(-1, 3, 3), rays.reshape(-1, 3, 2), tau.reshape(-1, 3)
    ))  # fmt: skip
    return models.reshape(len(trials), -1, models.shape[-1])


def _stacked(solutions: tuple[Array, Array, Array, Array]) -> Array:
    rotations, *rest = solutions
    return np.concatenate([rotations.reshape(*rotations.shape[:2], 9), *rest], axis=2)


def _motions(models: Array) -> Motions:
    return Motions(models[:, :9].reshape(-1, 3, 3), models[:, 9:12], models[:, 12:15],
                   models[:, 15:18])  # fmt: skip


def observed(trials: Trials, count: int = POINTS) -> Iterator[Observations]:
    """The first so many points of each frame."""
    view = camera()
    by_ray, mounts = view.pixel_jacobian(trials.rays[0]), Mounts.one(view.row_time_gradient)
    for points, rays, tau in zip(trials.points, trials.rays, trials.tau, strict=True):
        yield Observations.of(points[:count], rays[:count], tau[:count], by_ray[:count], mounts)


def _best(models: Array, trials: Trials, scale: float) -> Motions:
    """Of the solutions (h,k,18) of each frame the one with the least truncated error."""
    found = np.full((len(models), STATE_SIZE), np.nan)
    for i, frame in enumerate(observed(trials)):
        states = _states(models[i][~np.isnan(models[i][:, 0])])
        costs = [np.minimum(frame.squared_errors(state), scale**2).sum() for state in states]
        if costs:
            found[i] = states[np.argmin(costs)]
    return _of_states(found)


def _refined(models: Array, trials: Trials, threshold: float) -> Motions:
    """Local optimization and final refinement of the Localizer on all points."""
    prior, _ = assumptions(
        camera().readout_time, Rig.of(camera()), LocalizerConfig(), find_solver("r6p_vcwt")
    )
    noise = EXPECTED_NOISE * threshold
    found = np.full((len(models), STATE_SIZE), np.nan)
    for i, frame in enumerate(observed(trials)):
        if np.isnan(models[i, 0]):
            continue
        state, cost = optimize(
            _states(models[i : i + 1]), np.zeros(1), frame.packed, 8.0 * threshold, threshold,
            prior, noise,
        )  # fmt: skip
        if np.isfinite(cost):
            near = frame.only(np.flatnonzero(frame.squared_errors(state) < 4.0 * threshold**2))
            found[i] = refine(near.packed, state, (1e6, 0.0), prior, noise, 2, 10, 1e-6)[0]
    return _of_states(found)


def _states(models: Array) -> Array:
    """States (k,24) of models (k,18), the other way round."""
    c, w, t = models[:, 9:12], models[:, 12:15], models[:, 15:18]
    return np.hstack([models[:, :12], -w, np.cross(w, c) - t, np.zeros((len(models), 6))])


def _of_states(found: Array) -> Motions:
    w, translation = -found[:, 12:15], found[:, 9:12]
    return Motions(found[:, :9].reshape(-1, 3, 3), translation, w,
                   np.cross(w, translation) - found[:, 15:18])  # fmt: skip
