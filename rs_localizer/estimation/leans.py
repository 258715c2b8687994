# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The Gaussian of one hypothesis, and of its leans before a plane.

It is Laplace's approximation about the optimum. If a plane's lean is hardly known, it is nested
(Rue, Martino, Chopin 2009): one Gaussian beside each lean of a grid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, BoolArray1, IntArray
from rs_localizer.core.so3 import exp
from rs_localizer.core.state import PARAMETERS, TURN, rotation_of, step_between
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
from rs_localizer.native import entry, inlined

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


class _Grid(NamedTuple):
    """Leans along axes that are hardly known, in steps from that of a mode."""

    frame: Frame
    terms: PriorTerms
    alone: Mode
    axes: Array  # (k,3) of rotations, camera axes
    steps: Array  # (k,) rad
    centre: Array  # (3,) of the plane

    def turned(self, place: Sequence[int] | IntArray) -> Array:
        """Return the rotation (3,3) from the mode to a place (k,)."""
        return exp(-(place * self.steps) @ self.axes)


def over_leans(frame: Frame, mode: Mode, terms: PriorTerms) -> Mode:
    """Integrate the mode of a plane over its leans, if they are hardly known.

    There is a Gaussian beside each lean of a grid, along the one or two axes that are hardly known.
    Noise, inliers and the size of the smooth error are those of the mode.
    """
    plane, centre, normal = plane_of(frame.points, frame.chosen)
    across = rotation_of(mode.state) @ normal
    flat = np.eye(3) - np.outer(across, across)
    sizes, axes = np.linalg.eigh(flat @ mode.covariance[TURN, TURN] @ flat)
    if not (plane and sizes[2] > _KNOWN_LEAN**2):
        return mode
    # The mirrored lean may lie beyond others that are out of the question.
    twin = leaning_less(mode.state, centre, normal, 2.0)
    away = axes.T @ step_between(mode.state, twin)[TURN]
    worst = [2, 1] if max(sizes[1], away[1] ** 2) > _KNOWN_LEAN**2 else [2]
    steps = _SPACING * np.sqrt(np.maximum(sizes[worst], TINY))
    frame = frame._replace(
        shared=frame.shared.at(mode.size), noise=frame.noise._replace(deviation=mode.noise)
    )
    # The mode is evaluated with its own noise and smooth error, not with a mixture of sizes.
    alone, _, _ = mode_of(frame, mode.state, linear_at(frame, mode.state), terms)
    if not alone.evidence > -math.inf:
        return mode
    grid, origin = _Grid(frame, terms, alone, axes.T[worst], steps, centre), (0,) * len(worst)
    starts: dict[tuple[int, ...], Array] = {origin: alone.state}
    parts: dict[tuple[int, ...], tuple[Mode, float]] = {}
    _explore(grid, starts, parts, 2 * len(worst) + 1)  # the lean of the mode, and those beside it
    known = np.array([evidence for _, evidence in parts.values()])
    falls = known[0] - 0.5 * (known[1::2] + known[2::2])
    if np.any(falls > _SPACING**2):
        shares = _SPACING / np.sqrt(2.0 * np.maximum(falls, 0.5 * _SPACING**2))
        steps = steps * np.where(falls > _SPACING**2, np.maximum(shares, _LEAST_SHARE), 1.0)
        grid, starts, parts = grid._replace(steps=steps), {origin: alone.state}, {}
        _explore(grid, starts, parts, len(known))
    starts.setdefault(tuple(np.rint(away[worst] / steps).astype(int).tolist()), twin)
    _explore(grid, starts, parts, _MOST_PARTS)
    modes, evidences = zip(*parts.values(), strict=True)
    if not max(evidences) > -math.inf:
        return mode
    area = float(np.log(steps / (_PIN * steps[-1] * math.sqrt(2.0 * math.pi))).sum())
    leaning = Gaussians(
        np.array([part.state for part in modes]), np.zeros((len(modes), 0)),
        np.array([part.covariance for part in modes]), np.array(evidences) + area,
    )  # fmt: skip
    mixed = mixture(leaning, np.zeros(len(modes)), 1.0)
    return mode._replace(
        state=mixed.state, covariance=mixed.covariance,
        evidence=mode.evidence + mixed.evidence - alone.evidence,
    )  # fmt: skip


def _explore(
    grid: _Grid, starts: dict[tuple[int, ...], Array],
    parts: dict[tuple[int, ...], tuple[Mode, float]], most: int,
) -> None:  # fmt: skip
    """Fit the leans from their starts, in this order, and those beside all that are probable."""
    sides: IntArray = np.eye(len(grid.steps), dtype=np.int64)
    while len(parts) < min(len(starts), most):
        place, start = list(starts.items())[len(parts)]
        part = _pinned(grid, place, start)
        if not part.evidence > -math.inf:
            parts[place] = part, -math.inf
            continue
        # With the noise that the least cost leaves (Student's): what a motion leaves beyond the
        # best one tells the less, the fewer the points.
        freedom, more = max(grid.alone.freedom, 6.0), part.cost - grid.alone.cost
        beyond = max(more / freedom, _MOST_BETTER - 1.0)
        evidence = part.evidence + 0.5 * (more - freedom * math.log1p(beyond))
        parts[place] = part, evidence
        if not evidence > max(each for _, each in parts.values()) - _LEAST_PART:
            continue
        old = rotation_of(part.state)
        for side in (each for axis in sides for each in (axis, -axis)):
            begin, beside = part.state.copy(), place + side
            # About the middle of the plane.
            new = grid.turned(beside) @ grid.turned(place).T @ old
            begin[:9], begin[9:12] = new.ravel(), begin[9:12] + (old - new) @ grid.centre
            if len(starts) < _MOST_PARTS:
                starts.setdefault(tuple(beside.tolist()), begin)


def _pinned(grid: _Grid, place: Sequence[int], start: Array) -> Mode:
    """Return the Gaussian about the optimum near a start (24,) with the lean of a place."""
    turn, terms = grid.turned(place), grid.terms
    across = grid.axes @ turn.T / (_PIN * grid.steps[-1])
    pin, reference = np.zeros((1, PARAMETERS, PARAMETERS)), start.copy()
    pin[0, TURN, TURN] = across.T @ across
    reference[:9] = (turn @ rotation_of(grid.alone.state)).ravel()
    pinned = PriorTerms(
        np.concatenate([terms.informations, pin]), np.vstack([terms.references, reference]),
        terms.gravity, np.vstack([terms.pivots, np.zeros(3)]),
    )  # fmt: skip
    return mode_of(grid.frame, start, linear_at(grid.frame, start), pinned)[0]
