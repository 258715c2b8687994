# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The Gaussian of one hypothesis, and of its leans before a plane.

It is Laplace's approximation about the optimum. If a plane's lean is hardly known, it is nested
(Rue, Martino, Chopin 2009): one Gaussian beside each lean of a grid.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, BoolArray1, IntArray
from rs_localizer.core.so3 import exp
from rs_localizer.core.state import PARAMETERS, STATE_SIZE, TURN, step_between
from rs_localizer.estimation.gaussian import Gaussians, mixture
from rs_localizer.estimation.linear_fit import (
    NO_TURN,
    Linear,
    Noise,
    cost_of,
    fit,
    known_at,
    linear_of,
    taken_by,
)
from rs_localizer.estimation.points import leaning_less, plane_of
from rs_localizer.estimation.prior import PriorTerms
from rs_localizer.estimation.projection import linearized
from rs_localizer.estimation.robust import TINY, apply_step
from rs_localizer.estimation.smooth_error import Shared
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
# Neighbours are looked at of all parts up to these odds (logarithm) against the best: of a Gaussian
# they reach beyond three deviations.
_LEAST_PART, _MOST_PARTS = 4.0, 100
# If the evidence falls faster than the mode's Gaussian, steps shrink at least to this.
_LEAST_SHARE = 0.25
# Part of the squared errors that is left at least: of a camera that shakes, noise is a tenth.
_MOST_BETTER = 0.01


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


@entry
def linear_at(frame: Frame, state: Array1) -> Linear:
    """Return the products at a state (24,) without an in-frame rotation."""
    count = len(frame.chosen)
    lines = linearized(frame.data, count, state, np.zeros((count, 6)))
    return linear_of(lines, frame.chosen, False, frame.shared.rows)


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


def over_leans(frame: Frame, mode: Mode, terms: PriorTerms) -> Mode:
    """Integrate the mode of a plane over its leans, if they are hardly known."""
    if not np.isfinite(mode.covariance).all():  # so open that it cannot be computed
        return mode
    held = frame._replace(
        shared=frame.shared.at(mode.size), noise=frame.noise._replace(deviation=mode.noise)
    )
    states, covariances, evidences, whole = _leans(held, mode, terms)
    if not (len(states) and np.isfinite(whole)):
        return mode
    parts = Gaussians(states, np.zeros((len(states), 0)), covariances, evidences)
    mixed = mixture(parts, np.zeros(len(states)), 1.0)
    return mode._replace(
        state=mixed.state, covariance=mixed.covariance,
        evidence=mode.evidence + mixed.evidence - whole,
    )  # fmt: skip


@kernel
def _evidence_of(mode: Mode, least: float, freedom: float) -> float:
    """Return the evidence with the noise that the least cost leaves.

    Student's: what a motion leaves beyond the best one tells the less, the fewer the points.
    """
    beyond = max((mode.cost - least) / freedom, _MOST_BETTER - 1.0)
    return mode.evidence + 0.5 * (mode.cost - least - freedom * math.log1p(beyond))


@entry
def _leans(frame: Frame, mode: Mode, terms: PriorTerms) -> tuple[Array, Array, Array, float]:
    """Return Gaussians beside the leans of a grid, along the one or two axes that are hardly known.
    Noise, inliers and the size of the smooth error are taken from the mode.

    Returns:
        states (k,24), covariances (k,18,18), evidences (k,), of nothing where the lean is known;
        and that of the mode itself.
    """
    rotation, count = mode.state[:9].copy().reshape(3, 3), len(terms.informations)
    plane, centre, normal = plane_of(frame.points, frame.chosen)
    normal = rotation @ normal
    flat = np.eye(3) - normal * normal.reshape(3, 1)
    sizes, axes = np.linalg.eigh(flat @ mode.covariance[TURN, TURN].copy() @ flat)
    if not (plane and sizes[2] > _KNOWN_LEAN**2):
        nothing = np.zeros((0, PARAMETERS, PARAMETERS))
        return np.zeros((0, STATE_SIZE)), nothing, np.zeros(0), 0.0
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
    while first < last:
        turn = exp(-(places[first] * steps) @ axes)
        references[count], references[count, :9] = starts[first], (turn @ rotation).ravel()
        across = axes @ turn.T / (_PIN * steps[used - 1])
        informations[count, TURN, TURN] = across.T @ across
        part, _, _ = mode_of(frame, starts[first], linear_at(frame, starts[first]), pinned)
        states[first], covariances[first] = part.state, part.covariance
        evidences[first] = _evidence_of(part, alone.cost, freedom)
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
    if not best > -np.inf:
        last = 0
    area = np.prod(steps / (_PIN * steps[used - 1] * math.sqrt(2.0 * math.pi)))
    evidences[:last] += math.log(area)
    return states[:last], covariances[:last], evidences[:last], alone.evidence


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
