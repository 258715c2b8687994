# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Gaussians about motions: of a hypothesis, of its leans before a plane, and their one mixture.

The Gaussian of a hypothesis is Laplace's approximation about its optimum. If a plane's lean is
hardly known, it is nested (Rue, Martino, Chopin 2009): one Gaussian beside each lean of a grid.

The points say precisely in which direction they are and roughly how far away. A camera whose
orientation they hardly tell is somewhere on an arc about them, and arcs leave their tangents: by
half of 3 m times the square of 4 degrees, 7 mm, where the ellipsoid is thinner than 1 mm. In the
terms of a step (turn ``phi``, move ``rho``; see :mod:`rs_localizer.estimation.robust`), points at
``p`` in camera axes that move there by ``d`` are seen from

    rho = p - exp([phi]x) (p + d)
        = -d - phi x p - (phi x (phi x p) / 2 + phi x d) - ...

of which the ellipsoid has the first two. Arcs also turn the axes: a step from one point of an arc,
told from another one, moves along other axes. So motions differ by offsets about the middle of the
points, where arcs are straight (:func:`rs_localizer.estimation.prior.offset_between`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, Array3, BoolArray1, IntArray
from rs_localizer.core.so3 import exp, hat_of
from rs_localizer.core.state import PARAMETERS, STATE_SIZE, TURN, step_between
from rs_localizer.estimation.linear_fit import (
    NO_TURN,
    Linear,
    Noise,
    Shared,
    cost_of,
    fit,
    known_at,
    linear_of,
    taken_by,
)
from rs_localizer.estimation.points import leaning_less, plane_of
from rs_localizer.estimation.prior import ROUNDING, PriorTerms, offset_between, terms_at
from rs_localizer.estimation.projection import linearized
from rs_localizer.estimation.robust import TINY, apply_step
from rs_localizer.native import entry, inlined, kernel

# Linearizations of a mode, at most; and the last one is where the step to the optimum leaves its
# tangent by less than this part of the noise.
_LOOKS, _STRAIGHT = 8, 0.1
# Reach of each pair of a step (rotation and move, velocities, accelerations) in the first row.
_REACH = (1.0, 0.5, 0.125)
# A step that raises the cost by more than this is halved: in valleys that bend it would leave them.
_SHORT, _HALVINGS = 1e-3, 6
# Deviation of a lean (rad, 2 deg) up to which one Gaussian will do.
_KNOWN_LEAN = 0.035
# Steps of the grid of leans in deviations: the trapezoid rule is right to 3e-4 of a Gaussian, and
# leans pinned to this part of a step are wider by 1e-3.
_SPACING, _PIN = 1.5, 0.03
# A mode is nearly Gaussian if the evidence a step beside it falls as its Gaussian does, to this
# part, and if the mirrored lean adds less than this part to its variance.
_ALIKE, _NO_PART = 0.15, 0.05
# Neighbours are looked at of all parts up to these odds (logarithm) against the best: of a Gaussian
# they reach beyond three deviations.
_LEAST_PART, _MOST_PARTS = 4.0, 100
# If the evidence falls faster than the mode's Gaussian, steps shrink at least to this.
_LEAST_SHARE = 0.25
# Part of the squared errors that is left at least: of a camera that shakes, noise is a tenth.
_MOST_BETTER = 0.01


class Gaussians(NamedTuple):
    """Gaussians about motions, each with its evidence.

    Behind the 18 numbers of a step covariances may have those of an in-frame turn.
    """

    states: Array2  # (k,24)
    turns: Array2  # (k,t) coefficients of the in-frame turn
    covariances: Array3  # (k,18 + t,18 + t)
    evidences: Array1  # (k,) logarithms


class Mixture(NamedTuple):
    """Gaussians as one."""

    state: Array  # (24,)
    turn: Array  # (t,)
    covariance: Array  # (18 + t,18 + t)
    evidence: float  # logarithm of the sum
    probable: Array  # (k,) weights in the mean


@entry
def weights_of(logarithms: Array1) -> Array:
    """Return the probabilities (k,) with these logarithms, up to a constant."""
    weights = np.exp(logarithms - np.max(logarithms))
    weights /= np.sum(weights)
    return weights


@entry
def mixture(parts: Gaussians, preferences: Array1, temper: float) -> Mixture:
    """Return the mixture of Gaussians, with the mean by their probabilities, second moments
    about it by probabilities to the power of ``temper``.

    Args:
        preferences: (k,) logarithms of odds that count in the mean alone.
    """
    count, size = len(parts.states), parts.covariances.shape[1]
    probable = weights_of(parts.evidences + preferences)
    possible, top = weights_of(temper * parts.evidences), np.max(parts.evidences)
    evidence = top + math.log(np.sum(np.exp(parts.evidences - top)))
    first = parts.states[np.argmax(probable)].copy()
    pivot, mean, turn = first[9:12].copy(), np.zeros(PARAMETERS), np.zeros(size - PARAMETERS)
    for k in range(count):
        step, _ = offset_between(first, parts.states[k], pivot)
        mean += probable[k] * step
        turn += probable[k] * parts.turns[k]
    state = apply_step(first, mean)
    # About the pivot, which the move of a step is not.
    state[9:12] = pivot - mean[3:6] + hat_of(pivot) @ mean[:3]
    pivot[:], by_step, away = state[9:12], np.eye(6), np.empty(size)
    covariance = np.zeros((size, size))
    for k in range(count):
        away[:PARAMETERS], by_step[:, :3] = offset_between(state, parts.states[k], pivot)
        away[PARAMETERS:] = parts.turns[k] - turn
        # Covariances of steps as those of offsets, which go with the turn.
        about = parts.covariances[k].copy()
        about[:6] = by_step @ about[:6]
        about[:, :6] = about[:, :6].copy() @ by_step.T
        for i in range(size):
            for j in range(size):
                covariance[i, j] += possible[k] * (about[i, j] + away[i] * away[j])
    return Mixture(state, turn, covariance, evidence, probable)


@entry
def is_motion(state: Array1, covariance: Array2) -> bool:
    """Return whether both are finite, and the rotation is one: points on a line let it run away."""
    turn = state[:9].copy().reshape(3, 3)
    off = np.max(np.abs(turn @ turn.T - np.eye(3)))
    return bool(np.all(np.isfinite(state)) and np.all(np.isfinite(covariance)) and off < ROUNDING)


@entry
def along_arcs(covariance: Array2, centre: Array1) -> Array:
    """Return the covariance to second order in the move; the rotation has no second order.

    The mean stays where the points fit best, so that the mean of the second order counts, too. Let
    ``s_i = y^T H_i y`` for a Gaussian ``y`` about zero with covariance ``C``. Then ``E[s_i]`` is
    ``tr(H_i C)``, and the mean of ``s_i s_j`` is ``E[s_i] E[s_j] + 2 tr(H_i C H_j C)``.

    Args:
        covariance: (18,18), of a step.
        centre: (3,) of the points, in camera axes.
    """
    # y = (phi, d): d = -rho + [p]x phi, and the forms H_i.
    by_step, forms = np.diag(np.repeat(np.array([1.0, -1.0]), 3)), np.zeros((3, 6, 6))
    by_step[3:, :3] = hat_of(centre)
    for i in range(3):  # -phi x d, and -phi x (phi x p) / 2 = (p (phi . phi) - phi (phi . p)) / 2
        j, k = (i + 1) % 3, (i + 2) % 3
        forms[i, j, 3 + k] = forms[i, 3 + k, j] = -0.5
        forms[i, k, 3 + j] = forms[i, 3 + j, k] = 0.5
        for axis in range(3):
            forms[i, axis, axis] += 0.5 * centre[i]
            forms[i, i, axis] -= 0.25 * centre[axis]
            forms[i, axis, i] -= 0.25 * centre[axis]
    farther, both = covariance.copy(), by_step @ covariance[:6, :6].copy() @ by_step.T
    for i in range(3):
        one = forms[i] @ both
        for j in range(3):
            other = forms[j] @ both
            second = np.trace(one) * np.trace(other) + 2.0 * np.sum(one * other.T)
            farther[3 + i, 3 + j] += second
    return farther


class Frame(NamedTuple):
    """The points that the best motion of a frame leaves, the same for all hypotheses."""

    data: Array2  # packed, all points
    points: Array2  # (n,3)
    chosen: BoolArray1  # (n,) inliers
    shared: Shared
    noise: Noise
    focal_length: float  # px
    depth: float  # m


class Mode(NamedTuple):
    """A Gaussian about an optimum, and its evidence."""

    state: Array1  # (24,)
    covariance: Array2  # (18,18)
    evidence: float  # logarithm; minus infinity: nothing was found
    cost: float  # that is left, noise variances
    noise: float  # px
    size: float  # px, of the smooth error
    freedom: float


class Speeds(NamedTuple):
    """Typical speeds of a camera, slowest first."""

    parts: Array1  # (k,) of the configured one
    odds: Array1  # (k,) logarithms, by all but the points
    preferences: Array1  # (k,) logarithms of odds that count in the mean alone
    turn_known: bool  # a rotation is known, and what it leaves of a turn goes with no speed


@entry
def modes_at(
    frame: Frame, start: Array1, terms: PriorTerms, speeds: Speeds, planar: bool, far: float
) -> tuple[Gaussians, Array]:
    """Return the Gaussians of typical speeds near a state (24,); of a plane, over its leans.

    Args:
        far: log odds beside a better speed, beyond which no faster one is tried.

    Returns:
        those that were found, with the odds of their speeds; and (k,4) which speed, noise (px),
        size of the smooth error (px) and degrees of freedom.
    """
    count, found, best = len(speeds.parts), 0, -np.inf
    states, covariances = np.empty((count, STATE_SIZE)), np.empty((count, PARAMETERS, PARAMETERS))
    evidences, numbers = np.empty(count), np.empty((count, 4))
    near, linear = start, linear_at(frame, start)
    for k in range(count):
        known = terms_at(terms, speeds.parts[k], speeds.turn_known)
        mode, near, linear = mode_of(frame, near, linear, known)
        if planar and mode.evidence > -np.inf:
            mode = over_leans(frame, mode, known)
        evidence = mode.evidence + speeds.odds[k]
        if evidence > -np.inf:
            states[found], covariances[found] = mode.state, mode.covariance
            evidences[found] = evidence
            numbers[found] = np.array([1.0 * k, mode.noise, mode.size, mode.freedom])
            found += 1
        best = max(best, evidence)
        if evidence < best - far:
            break
    turns = np.zeros((found, 0))
    return Gaussians(states[:found], turns, covariances[:found], evidences[:found]), numbers[:found]


@entry
def linear_at(frame: Frame, state: Array1) -> Linear:
    """Return the products at a state (24,) without an in-frame rotation."""
    count = len(frame.chosen)
    lines = linearized(frame.data, count, state, np.zeros((count, 6)))
    return linear_of(lines, frame.chosen, False, frame.shared)


@entry
def mode_of(
    frame: Frame, start: Array1, linear: Linear, terms: PriorTerms
) -> tuple[Mode, Array, Linear]:
    """Return the Gaussian about the optimum near a state (24,), where the products are.

    And the state and the products of the last linearization: the next one may begin there.
    """
    origin, shared = start, frame.shared
    for look in range(_LOOKS):
        known = known_at(terms, origin)
        found = fit(linear, shared, known, frame.noise, NO_TURN, True)
        if not found.evidence > -np.inf:
            break
        if look == _LOOKS - 1 or _bent(found.step, frame) < _STRAIGHT * found.noise:
            break
        taken, variance = taken_by(shared.squares, found.size, found.noise), found.noise**2
        most = cost_of(linear, taken, variance, known) + _SHORT
        step, trial = found.step, origin
        for _ in range(_HALVINGS):
            trial = apply_step(origin, step)
            linear = linear_at(frame, trial)
            if cost_of(linear, taken, variance, known_at(terms, trial)) <= most:
                break
            step = 0.5 * step
        origin = trial
    finite = found.evidence > -np.inf and np.all(np.isfinite(found.covariance))
    return Mode(
        apply_step(origin, found.step) if finite else origin, found.covariance,
        found.evidence if finite else -np.inf, found.cost, found.noise, found.size, found.freedom,
    ), origin, linear  # fmt: skip


@inlined
def _bent(step: Array, frame: Frame) -> float:
    """Return how far (px) a step leaves its tangent: the square of all that it rotates."""
    total = 0.0
    for k in range(0, PARAMETERS, 3):
        length = math.sqrt(step[k] ** 2 + step[k + 1] ** 2 + step[k + 2] ** 2)
        # Rows are up to half a readout from the middle one.
        total += length * _REACH[k // 6] / (1.0 if k % 6 == 0 else frame.depth)
    return 0.5 * frame.focal_length * total * total


@entry
def over_leans(frame: Frame, mode: Mode, terms: PriorTerms) -> Mode:
    """Integrate the mode of a plane over its leans, if they are hardly known."""
    if not np.all(np.isfinite(mode.covariance)):  # so open that it cannot be computed
        return mode
    shared, noise = frame.shared, frame.noise
    held = Frame(
        frame.data, frame.points, frame.chosen,
        Shared(shared.rows, shared.squares, np.array([mode.size]), np.zeros(1)),
        Noise(mode.noise, noise.correction, noise.decided, noise.expected),
        frame.focal_length, frame.depth,
    )  # fmt: skip
    parts, whole = _leans(held, mode, terms)
    if not (len(parts.states) and np.isfinite(whole)):
        return mode
    mixed = mixture(parts, np.zeros(len(parts.states)), 1.0)
    return Mode(
        mixed.state, mixed.covariance, mode.evidence + mixed.evidence - whole, mode.cost,
        mode.noise, mode.size, mode.freedom,
    )  # fmt: skip


@kernel
def _evidence_of(mode: Mode, least: float, freedom: float) -> float:
    """Return the evidence with the noise that the least cost leaves.

    Student's: what a motion leaves beyond the best one tells the less, the fewer the points.
    """
    beyond = max((mode.cost - least) / freedom, _MOST_BETTER - 1.0)
    return mode.evidence + 0.5 * (mode.cost - least - freedom * math.log1p(beyond))


@kernel
def _leans(frame: Frame, mode: Mode, terms: PriorTerms) -> tuple[Gaussians, float]:
    """Return Gaussians beside the leans of a grid, along the one or two axes that are hardly known.
    Noise, inliers and the size of the smooth error are taken from the mode.

    Returns:
        Gaussians, none where the lean is known, and one if the mode is nearly Gaussian; and the
        evidence of the mode itself.
    """
    rotation, count = mode.state[:9].copy().reshape(3, 3), len(terms.informations)
    plane, centre, normal = plane_of(frame.points, frame.chosen)
    normal = rotation @ normal
    flat = np.eye(3) - normal * normal.reshape(3, 1)
    sizes, axes = np.linalg.eigh(flat @ mode.covariance[TURN, TURN].copy() @ flat)
    if not (plane and sizes[2] > _KNOWN_LEAN**2):
        nothing = np.zeros((0, STATE_SIZE)), np.zeros((0, 0)), np.zeros((0, PARAMETERS, PARAMETERS))
        return Gaussians(*nothing, np.zeros(0)), 0.0
    # The mirrored lean may lie beyond others that are out of the question.
    _, twin = leaning_less(frame.points, frame.chosen, mode.state, 2.0)
    away = axes.T @ step_between(mode.state, twin)[TURN]
    used = 2 if max(sizes[1], away[1] ** 2) > _KNOWN_LEAN**2 else 1
    axes, away = axes.T[::-1][:used].copy(), away[::-1][:used].copy()
    steps = _SPACING * np.sqrt(np.maximum(sizes[::-1][:used], TINY))
    # The mode is evaluated with its own noise and smooth error, not with a mixture of sizes.
    alone, _, _ = mode_of(frame, mode.state, linear_at(frame, mode.state), terms)
    freedom = max(mode.freedom, 6.0)
    informations = np.zeros((count + 1, PARAMETERS, PARAMETERS))
    references, pivots = np.empty((count + 1, STATE_SIZE)), np.zeros((count + 1, 3))
    informations[:count], references[:count] = terms.informations, terms.references
    pivots[:count] = terms.pivots
    pinned = PriorTerms(informations, references, terms.gravity, pivots)
    places, starts = np.zeros((_MOST_PARTS, used), np.int64), np.empty((_MOST_PARTS, STATE_SIZE))
    states, evidences = np.empty((_MOST_PARTS, STATE_SIZE)), np.empty(_MOST_PARTS)
    covariances = np.empty((_MOST_PARTS, PARAMETERS, PARAMETERS))
    starts[0], first, last, best, measured = alone.state, 0, 1, -np.inf, False
    beside, looked, is_gaussian = 2 * used + 1, 0, True  # the mode, leans beside it, mirrored one
    falls = np.ones((used, 2))
    while first < last:
        turn = exp(-(places[first] * steps) @ axes)
        references[count], references[count, :9] = starts[first], (turn @ rotation).ravel()
        across = axes @ turn.T / (_PIN * steps[used - 1])
        informations[count, TURN, TURN] = across.T @ across
        part, _, _ = mode_of(frame, starts[first], linear_at(frame, starts[first]), pinned)
        states[first], covariances[first] = part.state, part.covariance
        evidences[first] = _evidence_of(part, alone.cost, freedom)
        best, first = max(best, evidences[first]), first + 1
        if first == beside and not measured:
            falls = (evidences[0] - evidences[1:beside]).reshape(used, 2) / (0.5 * _SPACING**2)
            is_gaussian = bool(np.max(np.abs(falls - 1.0)) < _ALIKE)
            measured, shares = True, np.ones(used)
            for axis in range(used):
                fall = np.mean(falls[axis])
                if fall > 2.0:
                    shares[axis] = max(1.0 / math.sqrt(fall), _LEAST_SHARE)
            if np.any(shares < 1.0):
                steps *= shares
                first, last, best = 0, 1, -np.inf
                continue
        if first == looked and is_gaussian:
            twice = np.exp(min(evidences[looked - 1] - evidences[0], 0.0)) * (looked > beside)
            if np.all(twice * away**2 < _NO_PART * (steps / _SPACING) ** 2):
                return _bent_by(mode, axes, falls, alone.evidence), alone.evidence
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
        if first == 1:
            looked = _queue(places, starts, last, np.rint(away / steps).astype(np.int64), twin)
            last = looked
    if not best > -np.inf:
        last = 0
    area = np.prod(steps / (_PIN * steps[used - 1] * math.sqrt(2.0 * math.pi)))
    evidences[:last] += math.log(area)
    turns = np.zeros((last, 0))
    return Gaussians(states[:last], turns, covariances[:last], evidences[:last]), alone.evidence


@kernel
def _bent_by(mode: Mode, axes: Array, falls: Array, evidence: float) -> Gaussians:
    """Return a mode whose evidence has a third and a fourth order, as one Gaussian.

    Let the logarithm be ``-z^2 / 2 + s z^3 / 3 + c z^4 / 4.5``, with ``z`` in deviations. Then the
    mean is ``s`` and the variance ``1 + 8 c / 3 + 4 s^2``. The evidence grows by ``2 c / 3 + s^2``.

    Args:
        axes: (k,3) of the rotation.
        falls: (k,2) of the evidence a step beside the mode, either way, in those of a Gaussian.
    """
    step, covariance = np.zeros(PARAMETERS), mode.covariance.copy()
    for k in range(len(axes)):
        along = mode.covariance[:, TURN].copy() @ axes[k]
        along /= math.sqrt(np.sum(along[TURN] * axes[k]))
        skew = 0.5 * (falls[k, 1] - falls[k, 0])
        wide = 1.0 - 0.5 * (falls[k, 0] + falls[k, 1]) + 1.5 * skew**2
        step += skew * along
        covariance += 8.0 / 3.0 * wide * np.outer(along, along)
        evidence += 2.0 / 3.0 * wide
    states = apply_step(mode.state, step).reshape(1, STATE_SIZE)
    covariances = covariance.reshape(1, PARAMETERS, PARAMETERS)
    return Gaussians(states, np.zeros((1, 0)), covariances, np.array([evidence]))


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
