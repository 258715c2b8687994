# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Modes of a frame without an in-frame turn: Gaussians about its optima, and their mixture.

Each typical speed has a fit (docs/estimator.md), a Gaussian with its evidence (Laplace's
approximation), before a plane over its leans; the mixture becomes one Gaussian.

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

from rs_localizer.core.arrays import Array, Array1, Array2, Array3, BoolArray, IntArray
from rs_localizer.core.blocks import write
from rs_localizer.core.so3 import exp
from rs_localizer.core.state import PARAMETERS, STATE_SIZE, TURN, step_between
from rs_localizer.estimation.correlated import (
    Noise,
    Products,
    SmoothError,
    over_sizes,
    products_at,
    taken_by,
    volume_of,
    weighed,
)
from rs_localizer.estimation.plane import leaning_less, plane_of
from rs_localizer.estimation.prior import SPEEDS, PriorTerms, add_prior, offset_between, terms_at
from rs_localizer.estimation.refine import TINY, apply_step, inverted, solve_positive
from rs_localizer.native import entry, inlined, kernel

# Logarithm of the odds of rest against each typical speed before any frame: errors of maps that no
# polynomial of the image follows look like motion, and a hundred to one is what surveyed tags ask
# for.
REST_ODDS = math.log(100.0)
# Logarithm of the odds of a typical speed beside a better one, beyond which no faster one is tried.
_FAR_LESS_PROBABLE = 9.0
# The pose is the mean of the posterior. Its region is that of the posterior with probabilities to
# this power, about the same mean: it holds for a camera that moves so little that rest is more
# probable (1 would hold on average over all cameras, and not for that one). The odds for rest and
# those against an in-frame turn, which are choices, have no part in it.
TEMPER = 0.25
# Part of the squared errors that is left at least: of a camera that shakes, noise is a tenth.
_MOST_BETTER = 0.01
# Linearizations of a mode, at most; and the last one is where the step to the optimum leaves its
# tangent by less than this part of the noise.
_LOOKS, _STRAIGHT = 8, 0.1
# How far each pair of a step (turn and move, velocities, accelerations) reaches in the first row.
_REACH = (1.0, 0.5, 0.125)
# A step that raises the cost by more than this is halved: in valleys that bend it would leave them.
_SHORT, _HALVINGS = 1e-3, 6
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


@entry
def along_arcs(
    covariance: Array2, centre: Array1, weights: Array1, offsets: Array2, covariances: Array3
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
) -> tuple[Array, Array, Array, Array]:
    """Mean (24,) of Gaussians by the ones probabilities (k,), covariance (18,18) by the others.

    Both about the middle of the points, where arcs are straight (:func:`offset_between`). And the
    offsets (k,18) from the mean to all, and their covariances (k,18,18).
    """
    count, first = len(states), states[best]
    mean = np.zeros(PARAMETERS)
    for k in range(count):
        step, _ = offset_between(first, states[k], first[9:12])
        mean += counting[k] * step
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
    return state, covariance, offsets, abouts


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


class Frame(NamedTuple):
    """The points of a frame that its best motion leaves, and what is the same for all modes."""

    data: Array  # packed, all points
    points: Array  # (n,3)
    chosen: BoolArray  # (n,) inliers
    smooth: SmoothError
    noise: Noise
    focal_length: float  # px
    depth: float  # m


class _Held(NamedTuple):
    """Numbers that do not change with the lean of a mode."""

    taken: Array  # (q,) by the smooth error
    noise: float  # px
    cost: float  # noise variances, the least
    freedom: float


class Mode(NamedTuple):
    """A Gaussian about an optimum, and its evidence."""

    state: Array  # (24,)
    covariance: Array  # (18,18)
    evidence: float  # logarithm; minus infinity: nothing was found
    noise: float  # px
    size: float  # px, of the smooth error
    freedom: float


class _Modes(NamedTuple):
    states: Array  # (k,24)
    covariances: Array  # (k,18,18)
    evidences: Array  # (k,)
    errors: Array  # (k,3) noise, size, freedom


class Mixture(NamedTuple):
    """All modes of a frame."""

    state: Array  # (24,) their mean
    covariance: Array  # (18,18)
    arched: Array  # (18,18) of steps, see along_arcs
    evidence: float  # logarithm of the sum
    speeds: Array  # (s,) weights of the typical speeds in the covariance
    errors: Array  # (3,) of the most probable mode; the size is the root mean square of all


@kernel
def mixture_of(
    frame: Frame, start: Array, terms: PriorTerms, odds: Array, slowest: int, turn_known: bool,
    planar: bool,
) -> Mixture:  # fmt: skip
    """The modes of typical speeds and leans near a motion, and their mixture.

    Args:
        start: state (24,).
        terms: of the configured speed.
        odds: (s,) logarithms, of the typical speeds by all but the points.
        slowest: index of the first typical speed; the others follow.
        turn_known: whether a gyroscope knows the turn.
        planar: whether leans that are hardly known are integrated.
    """
    modes = _modes(frame, start, terms, odds, slowest, turn_known, planar)
    count, evidences = len(modes.evidences), modes.evidences
    weights, top, probable = np.zeros(len(SPEEDS)), np.max(evidences), evidences.copy()
    if top == -np.inf:
        return Mixture(
            start, modes.covariances[0], modes.covariances[0], top, weights, modes.errors[0]
        )  # fmt: skip
    for k in range(count):
        if SPEEDS[slowest + k] == 0.0:
            probable[k] += REST_ODDS
    first = int(np.argmax(probable))
    probable = np.exp(probable - probable[first])
    possible = np.exp(TEMPER * (evidences - top))
    total = top + math.log(np.sum(np.exp(evidences - top)))
    probable, possible = probable / np.sum(probable), possible / np.sum(possible)
    state, covariance, offsets, abouts = averaged(
        modes.states, modes.covariances, first, probable, possible
    )
    arched = along_arcs(covariance, state[9:12], possible, offsets, abouts)
    errors, shared = modes.errors[first].copy(), 0.0
    for k in range(count):
        weights[slowest + k] = possible[k]
    for k in range(count):  # apart from the stores: see test_kernels_round_in_one_way
        shared += possible[k] * modes.errors[k, 1] ** 2
    errors[1] = math.sqrt(shared)
    return Mixture(state, covariance, arched, total, weights, errors)


@inlined
def _modes(
    frame: Frame, start: Array, terms: PriorTerms, odds: Array, slowest: int, turn_known: bool,
    planar: bool,
) -> _Modes:  # fmt: skip
    """A Gaussian for each typical speed, the slowest first."""
    most = len(SPEEDS) - slowest
    modes = _Modes(
        np.empty((most, STATE_SIZE)), np.empty((most, PARAMETERS, PARAMETERS)), np.empty(most),
        np.empty((most, 3)),
    )  # fmt: skip
    near, count, best = start.copy(), 0, -np.inf
    if slowest == 0:
        near[12:] = 0.0
    products = products_at(frame.data, len(frame.chosen), near, frame.chosen, frame.smooth.rows)
    for speed in range(slowest, len(SPEEDS)):
        prior = terms_at(terms, SPEEDS[speed], turn_known)
        mode, near, products = _mode(frame, near, products, prior, odds[speed])
        if planar:
            mode = _over_leans(frame, mode, prior)
        write(modes.states[count], mode.state)
        modes.covariances[count], modes.evidences[count] = mode.covariance, mode.evidence
        errors = modes.errors[count]
        errors[0], errors[1], errors[2] = mode.noise, mode.size, mode.freedom
        count, best = count + 1, max(best, mode.evidence)
        if mode.evidence < best - _FAR_LESS_PROBABLE / TEMPER:
            break
    return _Modes(
        modes.states[:count], modes.covariances[:count], modes.evidences[:count],
        modes.errors[:count],
    )  # fmt: skip


@kernel
def _mode(
    frame: Frame, start: Array, products: Products, terms: PriorTerms, odds: float
) -> tuple[Mode, Array, Products]:
    """The Gaussian about the optimum near a state (24,), at which the products are.

    And the state and the products of the last linearization: the next one may begin there.
    """
    origin, points, smooth = start, len(frame.chosen), frame.smooth
    volume, slope = volume_of(terms), np.empty(PARAMETERS)
    matrix = np.empty((PARAMETERS, PARAMETERS))
    for look in range(_LOOKS):
        information, along = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
        prior_cost = add_prior(terms, origin, 1.0, information, along)
        found = over_sizes(products, smooth, information, along, prior_cost, volume, frame.noise)
        if not found.evidence > -np.inf:
            break
        if look == _LOOKS - 1 or _bent(found.step, frame) < _STRAIGHT * found.noise:
            break
        variance = found.noise * found.noise
        taken = taken_by(smooth.squares, found.size, found.noise)
        most = weighed(products, taken, matrix, slope) / variance + prior_cost + _SHORT
        step, trial = found.step.copy(), origin
        for _ in range(_HALVINGS):
            trial = apply_step(origin, step)
            products = products_at(frame.data, points, trial, frame.chosen, smooth.rows)
            cost = weighed(products, taken, matrix, slope) / variance
            if cost + add_prior(terms, trial, 1.0, information, along) <= most:
                break
            step *= 0.5
        origin = trial
    finite = found.evidence > -np.inf and np.all(np.isfinite(found.covariance))
    state = apply_step(origin, found.step) if finite else origin
    return Mode(
        state, found.covariance if finite else np.zeros((PARAMETERS, PARAMETERS)),
        found.evidence + odds if finite else -np.inf, found.noise, found.size, found.freedom,
    ), origin, products  # fmt: skip


@inlined
def _bent(step: Array, frame: Frame) -> float:
    """How far (px) a step leaves its tangent: the square of all that it turns."""
    total = 0.0
    for k in range(0, PARAMETERS, 3):
        length = math.sqrt(step[k] ** 2 + step[k + 1] ** 2 + step[k + 2] ** 2)
        # Rows are up to half a readout from the middle one.
        total += length * _REACH[k // 6] / (1.0 if k % 6 == 0 else frame.depth)
    return 0.5 * frame.focal_length * total * total


@inlined
def _of_unknown_noise(cost: float, held: _Held) -> float:
    """A cost, noise variances, where the noise is of the errors that the least cost leaves.

    Student's: what a motion leaves beyond the best one tells the less, the fewer the points.
    """
    freedom = max(held.freedom, 6.0)
    beyond = max((cost - held.cost) / freedom, _MOST_BETTER - 1.0)
    return held.cost + freedom * math.log1p(beyond)


@kernel
def _equations(
    frame: Frame, state: Array, terms: PriorTerms, held: _Held, information: Array, slope: Array
) -> float:
    """Fill in the normal equations, times the noise variance; the cost, noise variances."""
    variance = held.noise * held.noise
    products = products_at(frame.data, len(frame.chosen), state, frame.chosen, frame.smooth.rows)
    cost = weighed(products, held.taken, information, slope)
    return (cost + add_prior(terms, state, variance, information, slope)) / variance


@kernel
def _at_lean(
    frame: Frame, start: Array, terms: PriorTerms, held: _Held
) -> tuple[Array, Array, float, float]:
    """State (24,) and covariance (18,18) beside a lean; logarithm of half the volume, and cost."""
    variance = held.noise * held.noise
    information, slope = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    state = start
    for _ in range(_PINNED_STEPS):
        cost = _equations(frame, state, terms, held, information, slope)
        step, solved = solve_positive(information, -slope)
        if not solved:
            break
        state, gain = apply_step(state, step), -np.sum(step * slope) / variance
        if gain < _PINNED_GAIN:
            covariance = variance * inverted(information)
            return state, covariance, 0.5 * log_determinant_of_inverse(covariance), cost - gain
    return state, information, -np.inf, np.inf


@kernel
def _over_leans(frame: Frame, mode: Mode, terms: PriorTerms) -> Mode:
    """The mode of a plane, integrated over its leans where they are hardly known.

    Nested Laplace approximation: a Gaussian about the optimum beside each lean of a grid, along the
    one or two axes about which it is hardly known. Noise, inliers and scale are those of the mode.
    """
    rotation, count = mode.state[:9].copy().reshape(3, 3), len(terms.informations)
    plane, centre, normal = plane_of(frame.points, frame.chosen)
    normal = rotation @ normal
    flat = np.eye(3) - normal * normal.reshape(3, 1)
    sizes, axes = np.linalg.eigh(flat @ mode.covariance[TURN, TURN].copy() @ flat)
    if not (plane and sizes[2] > _KNOWN_LEAN**2):
        return mode
    # The mirrored lean may lie beyond others that are out of the question.
    _, twin = leaning_less(frame.points, frame.chosen, mode.state, 2.0)
    away = axes.T @ step_between(mode.state, twin)[TURN]
    used = 2 if max(sizes[1], away[1] ** 2) > _KNOWN_LEAN**2 else 1
    axes, away = axes.T[::-1][:used].copy(), away[::-1][:used].copy()
    steps = _SPACING * np.sqrt(np.maximum(sizes[::-1][:used], TINY))
    taken = taken_by(frame.smooth.squares, mode.size, mode.noise)
    held = _Held(taken, mode.noise, 0.0, mode.freedom)
    # By its own noise and smooth error, no mixture of sizes.
    origin, _, volume, least = _at_lean(frame, mode.state, terms, held)
    held = _Held(taken, mode.noise, least, mode.freedom)
    whole = volume - 0.5 * least
    informations = np.zeros((count + 1, PARAMETERS, PARAMETERS))
    references, pivots = np.empty((count + 1, STATE_SIZE)), np.zeros((count + 1, 3))
    informations[:count], references[:count] = terms.informations, terms.references
    pivots[:count] = terms.pivots
    pinned = PriorTerms(informations, references, terms.gravity, pivots)
    places, starts = np.zeros((_MOST_PARTS, used), np.int64), np.empty((_MOST_PARTS, STATE_SIZE))
    states, evidences = np.empty((_MOST_PARTS, STATE_SIZE)), np.empty(_MOST_PARTS)
    covariances = np.empty((_MOST_PARTS, PARAMETERS, PARAMETERS))
    starts[0], first, last, best, measured = origin, 0, 1, -np.inf, False
    while first < last:
        turn = exp(-(places[first] * steps) @ axes)
        references[count], references[count, :9] = starts[first], (turn @ rotation).ravel()
        across = axes @ turn.T / (_PIN * steps[used - 1])
        informations[count, TURN, TURN] = across.T @ across
        states[first], covariances[first], volume, cost = _at_lean(
            frame, starts[first], pinned, held
        )
        evidences[first] = volume - 0.5 * _of_unknown_noise(cost, held)
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
        return mode
    probable = np.exp(evidences[:last] - best)
    total = np.sum(probable)
    state, covariance, _, _ = averaged(
        states[:last], covariances[:last], int(np.argmax(probable)), probable / total,
        probable / total,
    )  # fmt: skip
    area = np.prod(steps / (_PIN * steps[used - 1] * math.sqrt(2.0 * math.pi)))
    evidence = mode.evidence - whole + best + math.log(area * total)
    return Mode(
        state,
        covariance,
        evidence,
        mode.noise,
        mode.size,
        mode.freedom,
    )


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
def log_determinant_of_inverse(matrix: Array) -> float:
    """Logarithm of the determinant of a covariance."""
    size = len(matrix)
    factor, total = np.zeros((size, size)), 0.0
    for i in range(size):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= factor[i, k] * factor[j, k]
            if i == j:
                rest = max(rest, 1e-15 * matrix[i, i])
                total += math.log(rest)
                factor[i, i] = math.sqrt(rest)
            else:
                factor[i, j] = rest / factor[j, j]
    return total
