# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Modes of a frame without an in-frame turn: Gaussians about its optima, and their mixture.

Typical speeds and the two leans of a plane are starts of one fit (docs/estimator.md); each becomes
a Gaussian with its evidence (Laplace's approximation), and the mixture one Gaussian.

The points say precisely in which direction they are and roughly how far away. A camera whose
orientation they hardly tell is somewhere on an arc about them, and arcs leave their tangents: by
half of 3 m times the square of 4 degrees, 7 mm, where the ellipsoid is thinner than 1 mm. In the
terms of a step (turn ``phi``, move ``rho``; see :mod:`rs_localizer.estimation.refine`), points at
``p`` in camera axes that move there by ``d`` are seen from

    rho = p - exp([phi]x) (p + d)
        = -d - phi x p - (phi x (phi x p) / 2 + phi x d) - ...

of which the ellipsoid has the first two. Arcs also turn the axes: a step from one point of an arc,
told from another one, moves along other axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.blocks import write
from rs_localizer.core.scales import SPEEDS
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.so3 import exp
from rs_localizer.core.state import PARAMETERS, STATE_SIZE, TURN, step_between
from rs_localizer.estimation.frame_fit import (
    fit_frame,
    log_determinant_of_inverse,
    products_of,
    smooth_at,
)
from rs_localizer.estimation.mirror import leaning_less, plane_of
from rs_localizer.estimation.observations import weighted
from rs_localizer.estimation.posterior import ITERATIONS, NO_SCALE, WIDEST_GATE
from rs_localizer.estimation.prior import PriorTerms, add_prior, offset_between, terms_at
from rs_localizer.estimation.refine import (
    TINY,
    apply_step,
    half_inverse,
    inverted,
    refine,
    solve_positive,
    squared,
)
from rs_localizer.estimation.residuals import linearized, normal_equations, squared_errors

# More steps of Gauss-Newton than any fit needs that ends.
STEPS = 25
# Logarithm of the odds of rest against each typical speed before any frame: errors of maps that no
# polynomial of the image follows look like motion, and a hundred to one is what surveyed tags ask
# for (benchmarks.honesty tags).
REST_ODDS = math.log(100.0)
# Logarithm of the odds of a typical speed beside a better one, beyond which no faster one is tried.
FAR_LESS_PROBABLE = 9.0
# The pose is the mean of the posterior. Its region is that of the posterior with probabilities to
# this power, about the same mean: it holds for a camera that moves so little that rest is more
# probable (1 would hold on average over all cameras, and not for that one). The odds for rest and
# those against an in-frame turn, which are choices, have no part in it.
TEMPER = 0.25
# Optima nearer than this part of a deviation are one.
_SAME = 1e-2
# Part of the squared errors that is left at least: of a camera that shakes, noise is a tenth.
_MOST_BETTER = 0.01
# No frame says more than this against a typical speed.
LEAST_LIKELY = -10.0
# Gate from which a smooth error is fitted, in thresholds: what it will explain stands outside of
# the widest one, and would stay there.
_FIRST_GATE = 2.0 * WIDEST_GATE
_FITS, _FINE = 4, 1e-6
# Deviation of a lean (rad, 2 deg) up to which one Gaussian will do.
_KNOWN_LEAN = 0.035
# Steps of the grid of leans in deviations: the trapezoid rule is right to 3e-4 of a Gaussian, and
# leans pinned to this part of a step are wider by 1e-3.
_SPACING, _PIN = 1.5, 0.03
# A last step beside a pinned lean gains less than this (noise variances): evidence to half of it.
_PINNED_STEPS, _PINNED_GAIN = 6, 1e-2
# Neighbours are looked at of all parts up to these odds (logarithm) against the best: of a Gaussian
# they reach beyond three deviations.
_LEAST_PART, _MOST_PARTS = 4.0, 100
# Where the evidence falls faster than that of the mode's Gaussian, steps shrink to this at least.
_LEAST_SHARE = 0.25
# Probabilities that have no part in the covariance.
_NO_PART = 1e-5


@kernel
def along_arcs(
    covariance: Array, centre: Array, weights: Array, offsets: Array, covariances: Array
) -> Array:
    """The covariance with the second order of the move; that of the turn has none.

    A mixture's is not that of one Gaussian: who turned by three deviations moved nine times as far
    off the tangent as who turned by one. The mean stays where the points fit best, so that the mean
    of the second order counts, too: for ``s_i = y^T H_i y`` of Gaussians ``y`` with mean ``m`` and
    covariance ``C``, ``E[s_i] = tr(H_i C) + m^T H_i m``, ``E[s_i s_j]`` is ``E[s_i] E[s_j] +
    2 tr(H_i C H_j C) + 4 m^T H_i C H_j m``, and ``E[y s_i] = m E[s_i] + 2 C H_i m``.

    Args:
        covariance: (18,18), or more, of a step.
        centre: (3,) of the points, in camera axes.
        weights: (k,) of Gaussians whose mixture it is.
        offsets: (k,18) of their means (:func:`offset_between`).
        covariances: (k,18,18) of the offsets.
    """
    # y = (phi, d): d = -rho + [p]x phi.
    by_step, forms = np.zeros((6, PARAMETERS)), np.zeros((3, 6, 6))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        by_step[i, i], by_step[3 + i, 3 + i] = 1.0, -1.0
        by_step[3 + j, i], by_step[3 + k, i] = centre[k], -centre[j]
        # (phi x (phi x p))_i = phi_i (phi . p) - p_i (phi . phi)
        for m in range(3):
            forms[i, i, m] -= 0.25 * centre[m]
            forms[i, m, i] -= 0.25 * centre[m]
            forms[i, m, m] += 0.5 * centre[i]
        forms[i, j, 3 + k] = forms[i, 3 + k, j] = -0.5
        forms[i, k, 3 + j] = forms[i, 3 + j, k] = 0.5
    farther, products, pulls = covariance.copy(), np.empty((3, 6, 6)), np.empty((3, 6))
    means = np.empty(3)
    for part in range(len(weights)):
        if weights[part] < _NO_PART:
            continue
        weight, offset = weights[part], offsets[part]
        mean, crossed = by_step @ offset, covariances[part] @ by_step.T
        both = by_step @ crossed
        for i in range(3):
            products[i], pulls[i] = forms[i] @ both, forms[i] @ mean
            means[i] = np.trace(products[i]) + np.sum(mean * pulls[i])
        for i in range(3):
            pulled = both @ pulls[i]
            for j in range(3):
                second = means[i] * means[j] + 2.0 * np.sum(products[i] * products[j].T)
                farther[3 + i, 3 + j] += weight * (second + 4.0 * np.sum(pulls[j] * pulled))
            first = weight * (means[i] * offset + 2.0 * crossed @ pulls[i])
            farther[3 + i, :PARAMETERS] += first
            farther[:PARAMETERS, 3 + i] += first
    return farther


@kernel
def averaged(
    states: Array, covariances: Array, best: int, counting: Array, possible: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Mean (24,) of Gaussians by the ones probabilities (k,), covariance (18,18) by the others.

    Both about the middle of the points, where arcs are straight (:func:`offset_between`). And the
    offsets (k,18) from the best one to all, from the mean to all, and their covariances (k,18,18).
    """
    count, first = len(states), states[best]
    steps, mean = np.empty((count, PARAMETERS)), np.zeros(PARAMETERS)
    for k in range(count):
        steps[k], _ = offset_between(first, states[k], first[9:12])
        mean += counting[k] * steps[k]
    # About the pivot, which the move of a step is not.
    state, middle = apply_step(first, mean), np.empty(3)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        middle[i] = first[9 + i] - mean[3 + i]
        middle[i] += first[9 + j] * mean[k] - first[9 + k] * mean[j]
    state[9:12] = middle
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    offsets, abouts = np.zeros((count, PARAMETERS)), np.zeros((count, PARAMETERS, PARAMETERS))
    for k in range(count):
        if possible[k] > 0.0:
            offsets[k], by_turn = offset_between(state, states[k], middle)
            covariance = covariance + possible[k] * offsets[k] * offsets[k].reshape(PARAMETERS, 1)
            if possible[k] > _NO_PART:
                abouts[k] = _about_pivot(covariances[k], by_turn)
                covariance = covariance + possible[k] * abouts[k]
    return state, covariance, steps, offsets, abouts


def mixed(
    parts: Sequence[tuple[Array, Array, Array]], probable: Array, possible: Array
) -> tuple[Array, Array, Array]:
    """State (24,), turn (28,3) and covariance of a mixture of these: the mean by the ones
    probabilities (k,), second moments about it by the others.
    """
    near, turned, _ = parts[int(probable.argmax())]
    steps = np.array([
        np.append(step_between(near, state), (turns - turned).ravel()) for state, turns, _ in parts
    ])  # fmt: skip
    mean = probable @ steps
    away = steps - mean
    within = np.einsum("k,kij->ij", possible, np.array([one for _, _, one in parts]))
    state = apply_step(near, mean[:PARAMETERS])
    turns = turned + mean[PARAMETERS:].reshape(-1, 3)
    return state, turns, within + (away.T * possible) @ away


@inlined
def _about_pivot(covariance: Array, by_turn: Array) -> Array:
    """A covariance (18,18) of steps as one of offsets, which go with the turn by (6,3)."""
    by_step = np.eye(PARAMETERS)
    by_step[:6, :3] = by_turn
    return by_step @ covariance @ by_step.T


class _Held(NamedTuple):
    """What does not change with the lean of a mode."""

    chosen: BoolArray  # (n,) inliers
    noise: float  # px
    cost: float  # noise variances, the least; NaN: that of the mode
    freedom: float
    field: Array  # (n,2,q) px, columns of the smooth error; their products leave the motion's
    pulls: Array  # (q,18) by how much it moves the motion, over the covariance


class Mode(NamedTuple):
    """A Gaussian about an optimum, and its evidence."""

    state: Array  # (24,)
    covariance: Array  # (18,18)
    evidence: float  # logarithm; minus infinity: nothing was found
    cost: float  # noise variances
    smooth: float  # px, scale of the smooth error
    held: _Held
    squared_errors: Array  # (n,) px^2, beside the smooth error


class _Modes(NamedTuple):
    states: Array  # (k,24)
    covariances: Array  # (k,18,18)
    evidences: Array  # (k,)
    costs: Array  # (k,)
    speeds: IntArray  # (k,) indices of SPEEDS
    smooths: Array  # (k,) px
    chosen: BoolArray  # (k,n) inliers
    squared_errors: Array  # (k,n) px^2


class Mixture(NamedTuple):
    """All modes of a frame."""

    state: Array  # (24,) their mean
    covariance: Array  # (18,18)
    arched: Array  # (18,18) of steps, see along_arcs
    evidence: float  # logarithm of the sum
    speeds: Array  # (5,) weights of the typical speeds in the covariance
    log_likelihoods: Array  # (5,) of the typical speeds
    smooth: float  # px, of the fastest: at rest, what moves looks like an error of the map
    shared: float  # px, of all: root mean square by their weights in the covariance
    evidences: Array  # (k,) of the modes
    costs: Array  # (k,) noise variances
    steps: Array  # (k,18) to them from the most probable one
    # Of the most probable one, beside the smooth error: where that is fitted, others are inliers
    chosen: BoolArray  # (n,)
    squared_errors: Array  # (n,) px^2


class Inliers(NamedTuple):
    """The points of a frame that its best motion leaves, and what it says of their noise."""

    data: Array  # packed, all points
    points: Array  # (n,3)
    chosen: BoolArray  # (n,)
    noise: float  # px
    freedom: float
    cost: float  # noise variances
    focal_length: float  # px
    threshold: float  # px


class SmoothError(NamedTuple):
    """Whether a smooth error is fitted, and what is known of the scales (15,), see `fit_frame`."""

    fitted: bool
    first: Array
    mean: Array
    precision: Array
    bend: Array  # (n,b), or (n,0)


@kernel
def mixture_of(
    inliers: Inliers, start: Array, terms: PriorTerms, odds: Array, by_turn: Array, slowest: int,
    turn_known: bool, planar: bool, smooth: SmoothError,
) -> Mixture:  # fmt: skip
    """The modes of typical speeds and leans near a motion, and their mixture.

    Args:
        start: state (24,).
        terms: of the configured speed.
        odds: (5,) logarithms, of the typical speeds before this frame.
        by_turn: (5,) log-likelihoods of them by what a gyroscope knows of this frame.
        slowest: index of the first typical speed; the others follow.
        turn_known: whether a gyroscope knows the turn.
        planar: whether the mirrored lean is a start, too.
    """
    modes = _modes(
        inliers, start, terms, odds + by_turn, slowest, turn_known, planar, smooth
    )  # fmt: skip
    count, evidences = len(modes.speeds), modes.evidences
    log_likelihoods, weights = np.full(len(SPEEDS), -np.inf), np.zeros(len(SPEEDS))
    total, probable = -np.inf, evidences.copy()
    for k in range(count):
        speed = modes.speeds[k]
        if SPEEDS[speed] == 0.0:
            probable[k] += REST_ODDS
        own = evidences[k] - odds[speed]
        log_likelihoods[speed] = _log_sum(log_likelihoods[speed], own)
        total = _log_sum(total, evidences[k])
    if total == -np.inf:
        return Mixture(
            start, modes.covariances[0], modes.covariances[0], total, weights, weights, 0.0, 0.0,
            evidences, modes.costs, np.zeros((count, PARAMETERS)), inliers.chosen,
            modes.squared_errors[0],
        )  # fmt: skip
    first = int(np.argmax(probable))
    probable = np.exp(probable - probable[first])
    possible = np.exp(TEMPER * (evidences - np.max(evidences)))
    probable, possible = probable / np.sum(probable), possible / np.sum(possible)
    state, covariance, steps, offsets, abouts = averaged(
        modes.states, modes.covariances, first, probable, possible
    )
    arched = along_arcs(covariance, state[9:12], possible, offsets, abouts)
    for k in range(count):
        weights[modes.speeds[k]] += possible[k]
    shared = 0.0
    for k in range(count):
        shared += possible[k] * modes.smooths[k] ** 2
    log_likelihoods = np.maximum(log_likelihoods - np.max(log_likelihoods), LEAST_LIKELY)
    return Mixture(
        state, covariance, arched, total, weights, log_likelihoods, modes.smooths[count - 1],
        math.sqrt(shared), evidences, modes.costs, steps, modes.chosen[first],
        modes.squared_errors[first],
    )  # fmt: skip


@inlined
def _log_sum(one: float, other: float) -> float:
    """Logarithm of the sum of two numbers whose logarithms these are."""
    most, least = max(one, other), min(one, other)
    return most if least == -np.inf else most + math.log1p(math.exp(least - most))


@inlined
def _modes(
    inliers: Inliers, start: Array, terms: PriorTerms, odds: Array, slowest: int, turn_known: bool,
    planar: bool, smooth: SmoothError,
) -> _Modes:  # fmt: skip
    """A Gaussian for each typical speed and each lean of a plane.

    The valleys of the two leans join where the camera is free to move: a mirrored start that leads
    back to the other lean would do so at every higher speed (so it did in 217 of 217 cases of
    benchmarks.frames planes).
    """
    data, most = weighted(inliers.data, inliers.chosen), 2 * len(SPEEDS)
    points = len(inliers.chosen)
    modes = _Modes(
        np.empty((most, STATE_SIZE)), np.empty((most, PARAMETERS, PARAMETERS)), np.empty(most),
        np.empty(most), np.empty(most, np.int64), np.empty(most),
        np.empty((most, points), np.bool_), np.empty((most, points)),
    )  # fmt: skip
    near, count, best = start.copy(), 0, -np.inf
    if slowest == 0:
        near[12:] = 0.0
    leans, twin, has_twin = planar, start, False
    for speed in range(slowest, len(SPEEDS)):
        prior = terms_at(terms, SPEEDS[speed], turn_known)
        mode = _mode(data, inliers, near, prior, odds[speed], smooth)
        near, other = mode.state, has_twin
        if leans and not has_twin:
            other, twin = leaning_less(inliers.points, inliers.chosen, near, 2.0)
        whole, open_ = mode, False
        if planar:
            whole, open_ = _over_leans(inliers, mode, twin if other else near, prior, smooth)
        count, here = _keep(modes, count, speed, whole), whole.evidence
        if other and not open_:
            second = _mode(data, inliers, twin, prior, odds[speed], smooth)
            leans = has_twin = _apart(mode, second)
            if has_twin:
                count = _keep(modes, count, speed, second)
                twin, here = second.state, max(here, second.evidence)
        best = max(best, here)
        if here < best - FAR_LESS_PROBABLE / TEMPER:
            break
    return _Modes(
        modes.states[:count], modes.covariances[:count], modes.evidences[:count],
        modes.costs[:count], modes.speeds[:count], modes.smooths[:count],
        modes.chosen[:count], modes.squared_errors[:count],
    )  # fmt: skip


@inlined
def _keep(modes: _Modes, count: int, speed: int, mode: Mode) -> int:
    """Write a mode behind so many others; their new number."""
    write(modes.states[count], mode.state)
    modes.covariances[count] = mode.covariance
    modes.evidences[count], modes.costs[count] = mode.evidence, mode.cost
    modes.speeds[count], modes.smooths[count] = speed, mode.smooth
    modes.chosen[count] = mode.held.chosen
    modes.squared_errors[count] = mode.squared_errors
    return count + 1


@inlined
def _apart(mode: Mode, other: Mode) -> bool:
    """Whether two modes are not the same optimum: by the squared angle between them, rad^2, for
    small ones.
    """
    squared, spread = 0.0, 0.0
    for i in range(9):
        squared += 0.5 * (mode.state[i] - other.state[i]) ** 2
    for i in range(3):
        spread += mode.covariance[i, i]
    return math.sqrt(squared) > _SAME * math.sqrt(max(spread, 0.0))


@kernel
def _mode(
    data: Array, inliers: Inliers, start: Array, terms: PriorTerms, odds: float,
    smooth: SmoothError,
) -> Mode:  # fmt: skip
    """The Gaussian about the optimum near a state (24,)."""
    noise, variance = inliers.noise, inliers.noise * inliers.noise
    state, information, cost = start, np.empty((PARAMETERS, PARAMETERS)), 0.0
    for _ in range(_FITS):
        state, information, cost, converged = refine(
            data, state, NO_SCALE, 0.0, terms, noise, 2, ITERATIONS, _FINE
        )
        if converged:
            break
    covariance, cost, scale = variance * inverted(information), cost / variance, 0.0
    beside = squared_errors(inliers.data, len(inliers.chosen), state)
    held = _Held(
        inliers.chosen, noise, inliers.cost, inliers.freedom, np.zeros((0, 2, 0)),
        np.zeros((0, PARAMETERS)),
    )  # fmt: skip
    evidence = log_evidence(
        log_determinant_of_inverse(covariance), _of_unknown_noise(cost, held), terms, inliers,
        inliers.chosen, noise,
    )  # fmt: skip
    if smooth.fitted and np.isfinite(evidence):
        fit = fit_frame(
            inliers.data, len(inliers.chosen), state, terms, inliers.threshold,
            _FIRST_GATE * inliers.threshold, noise, smooth.first, smooth.mean, smooth.precision,
            False, True, smooth.bend, STEPS,
        )  # fmt: skip
        if fit.finite:
            state, covariance, scale = fit.state, fit.covariance, fit.smooth
            cost = fit.left + fit.prior_cost
            evidence = log_evidence(
                fit.log_determinant, cost, terms, inliers, fit.inliers, fit.noise
            )
            held = _Held(fit.inliers, fit.noise, np.nan, fit.freedom, held.field, held.pulls)
            beside = fit.squared_errors
    if not (np.isfinite(evidence) and np.all(np.isfinite(covariance))):
        nothing = np.zeros((PARAMETERS, PARAMETERS))
        return Mode(start, nothing, -np.inf, np.inf, 0.0, held, beside)
    return Mode(state, covariance, evidence + odds, cost, scale, held, beside)


@inlined
def _of_unknown_noise(cost: float, held: _Held) -> float:
    """A cost, noise variances, where the noise is of the errors that the least cost leaves.

    Student's: what a motion leaves beyond the best one tells the less, the fewer the points.
    """
    freedom = max(held.freedom, 6.0)
    beyond = max((cost - held.cost) / freedom, _MOST_BETTER - 1.0)
    return held.cost + freedom * math.log1p(beyond)


@inlined
def _marginal(inliers: Inliers, mode: Mode, smooth: SmoothError) -> _Held:
    """What is held of a mode, and its smooth error, of which the scale is held, too.

    With columns ``F`` of the smooth error and ``L L^T = F^T F + (sigma/s)^2``: ``F L^-T`` and
    ``(L L^T)^-1 F^T A / s``.
    """
    held, count = mode.held, len(inliers.chosen)
    lines = linearized(inliers.data, count, mode.state, np.zeros((count, 6)))
    products = products_of(lines, held.chosen, lines.errors, False, True, smooth.bend).products
    own = products[PARAMETERS:, PARAMETERS:].copy()
    size = len(own)
    for k in range(size):
        own[k, k] += (held.noise / mode.smooth) ** 2
    half, scale, _ = half_inverse(own)
    field, column = np.zeros((count, 2, size)), np.zeros(size)
    for k in range(size):
        for j in range(k + 1):
            column[j] = half[k, j] * scale[j]
        field[:, :, k] = smooth_at(lines, held.chosen, column, smooth.bend)
    pulls = squared(half, scale) @ products[PARAMETERS:, :PARAMETERS].copy() / mode.smooth
    return _Held(held.chosen, held.noise, held.cost, held.freedom, field, pulls)


@kernel
def _equations(
    data: Array, state: Array, terms: PriorTerms, held: _Held, information: Array, slope: Array
) -> float:
    """Fill in the normal equations, the smooth error marginalized; the cost, noise variances."""
    variance, size = held.noise * held.noise, held.field.shape[2]
    cost = normal_equations(data, state, NO_SCALE, 0.0, 2, information, slope)
    if size > 0:
        count = len(held.field)
        lines = linearized(data, count, state, np.zeros((count, 6)))
        shared, along = np.zeros((size, PARAMETERS)), np.zeros(size)
        for i in range(count):
            if not held.chosen[i]:
                continue
            for side in range(2):
                row, error = lines.by_motion[i, side], lines.errors[i, side]
                for k in range(size):
                    factor, products = held.field[i, side, k], shared[k]
                    along[k] += factor * error
                    for a in range(PARAMETERS):
                        products[a] += factor * row[a]
        cost -= np.sum(along * along)
        slope -= shared.T @ along
        information -= shared.T @ shared
    return (cost + add_prior(terms, state, variance, information, slope)) / variance


@kernel
def _at_lean(
    data: Array, start: Array, terms: PriorTerms, held: _Held
) -> tuple[Array, Array, float]:
    """State (24,) and covariance (18,18) beside a lean, and logarithm of their probability."""
    variance = held.noise * held.noise
    information, slope = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    state = start
    for _ in range(_PINNED_STEPS):
        cost = _equations(data, state, terms, held, information, slope)
        step, solved = solve_positive(information, -slope)
        if not solved:
            break
        state, gain = apply_step(state, step), -np.sum(step * slope) / variance
        if gain < _PINNED_GAIN:
            covariance = variance * inverted(information)
            evidence = 0.5 * log_determinant_of_inverse(covariance)
            evidence -= 0.5 * _of_unknown_noise(cost - gain, held)
            pulled = held.pulls @ covariance
            return state, covariance - pulled.T @ pulled, evidence
    return state, information, -np.inf


@kernel
def _over_leans(
    inliers: Inliers, mode: Mode, twin: Array, terms: PriorTerms, smooth: SmoothError
) -> tuple[Mode, bool]:
    """The mode of a plane, integrated over its leans where they are hardly known; whether they are.

    Nested Laplace approximation: a Gaussian about the optimum beside each lean of a grid, along the
    one or two axes about which it is hardly known. Noise, inliers and scale are those of the mode.

    Args:
        twin: state (24,) of the mirrored lean, where the parts may be others; or that of the mode.
    """
    rotation, count = mode.state[:9].copy().reshape(3, 3), len(terms.informations)
    plane, centre, normal = plane_of(inliers.points, inliers.chosen)
    normal = rotation @ normal
    flat = np.eye(3) - normal * normal.reshape(3, 1)
    sizes, axes = np.linalg.eigh(flat @ mode.covariance[TURN, TURN].copy() @ flat)
    if not (plane and sizes[2] > _KNOWN_LEAN**2):
        return mode, False
    away = axes.T @ step_between(mode.state, twin)[TURN]
    used = 2 if max(sizes[1], away[1] ** 2) > _KNOWN_LEAN**2 else 1
    axes, away = axes.T[::-1][:used].copy(), away[::-1][:used].copy()
    steps = _SPACING * np.sqrt(np.maximum(sizes[::-1][:used], TINY))
    held, data = mode.held, weighted(inliers.data, mode.held.chosen)
    if mode.smooth > 0.0:
        held = _marginal(inliers, mode, smooth)
    information, slope = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    cost = _equations(data, mode.state, terms, held, information, slope)
    least = cost if np.isnan(held.cost) else held.cost
    held = _Held(held.chosen, held.noise, least, held.freedom, held.field, held.pulls)
    volume = log_determinant_of_inverse(held.noise * held.noise * inverted(information))
    whole = 0.5 * (volume - _of_unknown_noise(cost, held))
    informations = np.zeros((count + 1, PARAMETERS, PARAMETERS))
    references, pivots = np.empty((count + 1, STATE_SIZE)), np.zeros((count + 1, 3))
    informations[:count], references[:count] = terms.informations, terms.references
    pivots[:count] = terms.pivots
    pinned = PriorTerms(informations, references, terms.gravity, pivots)
    places, starts = np.zeros((_MOST_PARTS, used), np.int64), np.empty((_MOST_PARTS, STATE_SIZE))
    states, evidences = np.empty((_MOST_PARTS, STATE_SIZE)), np.empty(_MOST_PARTS)
    covariances = np.empty((_MOST_PARTS, PARAMETERS, PARAMETERS))
    starts[0], first, last, best, measured = mode.state, 0, 1, -np.inf, False
    while first < last:
        turn = exp(-(places[first] * steps) @ axes)
        references[count], references[count, :9] = starts[first], (turn @ rotation).ravel()
        across = axes @ turn.T / (_PIN * steps[used - 1])
        informations[count, TURN, TURN] = across.T @ across
        states[first], covariances[first], evidences[first] = _at_lean(
            data, starts[first], pinned, held
        )
        best, first = max(best, evidences[first]), first + 1
        if first == 2 * used + 1:  # the lean of the mode, and those beside it
            shrunk = False
            for axis in range(used):
                beside = evidences[2 * axis + 1] + evidences[2 * axis + 2]
                falls = evidences[0] - 0.5 * beside
                if falls > _SPACING**2 and not measured:
                    steps[axis] *= max(_SPACING / math.sqrt(2.0 * falls), _LEAST_SHARE)
                    shrunk = True
            measured = True
            if shrunk:
                first, last, best = 0, 1, -np.inf
                continue
            last = _queue(places, starts, last, np.rint(away / steps).astype(np.int64), twin)
        if not evidences[first - 1] > best - _LEAST_PART:
            continue
        near = states[first - 1]
        old = near[:9].copy().reshape(3, 3)
        for k in range(2 * used):
            place, begin = places[first - 1].copy(), near.copy()
            place[k // 2] += 1 - k % 2 * 2
            # About the middle of the plane.
            new = exp(-(place * steps) @ axes) @ turn.T @ old
            begin[:9] = new.ravel()
            begin[9:12] += old @ centre - new @ centre
            last = _queue(places, starts, last, place, begin)
    if not (best > -np.inf and np.isfinite(whole)):
        return mode, False
    probable = np.exp(evidences[:last] - best)
    total = np.sum(probable)
    state, covariance, _, _, _ = averaged(
        states[:last], covariances[:last], int(np.argmax(probable)), probable / total,
        probable / total,
    )  # fmt: skip
    area = np.prod(steps / (_PIN * steps[used - 1] * math.sqrt(2.0 * math.pi)))
    evidence = mode.evidence - whole + best + math.log(area * total)
    return Mode(
        state, covariance, evidence, mode.cost, mode.smooth, held, mode.squared_errors
    ), True


@inlined
def _queue(places: IntArray, starts: Array, last: int, place: IntArray, start: Array) -> int:
    """Put a place of a grid behind the others, if it is new and there is room; their number."""
    for k in range(last):
        if np.all(places[k] == place):
            return last
    if last < len(places):
        places[last], starts[last] = place, start
        last += 1
    return last


@kernel
def log_evidence(
    log_determinant: float, cost: float, terms: PriorTerms, inliers: Inliers, chosen: BoolArray,
    noise: float,
) -> float:  # fmt: skip
    """Logarithm of the probability of all pixels, but for a constant of the frame (Laplace).

    Args:
        log_determinant: of the covariance, over that of the prior of what stands behind the motion.
        cost: noise variances.
        terms: of the motion.
        chosen: (n,) inliers, about the motion at their best; others are anywhere in an image of a
            focal length squared.
        noise: px.
    """
    volume = 0.5 * log_determinant
    for k in range(PARAMETERS):
        if terms.informations[0, k, k] > 0.0:
            volume += 0.5 * math.log(terms.informations[0, k, k])
    count = np.count_nonzero(chosen)
    others = len(chosen) - count
    density = count * math.log(2.0 * math.pi * noise * noise)
    return volume - 0.5 * cost - density - 2.0 * others * math.log(inliers.focal_length)
