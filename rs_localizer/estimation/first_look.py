# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The first look at a frame: its best motion alone, and what tells whether it is all."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array1, Array2, BoolArray, BoolArray1, Out
from rs_localizer.core.state import LINEAR, VELOCITIES
from rs_localizer.estimation.observations import NEAREST, median_depth
from rs_localizer.estimation.plane import plane_of
from rs_localizer.estimation.posterior import LEAST_EIGENVALUE, Best, best_motion
from rs_localizer.estimation.prior import PriorTerms
from rs_localizer.estimation.refine import inverted
from rs_localizer.estimation.residuals import Lines, linearized
from rs_localizer.native import entry, inlined, kernel

# Points just outside of the gate that are no chance: shaking may have moved them there. The corners
# of one marker may, beside four and more others, be misplaced in the map. Beside fewer points, 12
# or 13 are a plain motion's of 20 that shake by a degree, and 3 or 4 lie just outside: of 25 such
# frames one was inside its region (benchmarks.frames bands).
_MARKER = 4
_NEAR_PART, _NEAR_GATE = 0.2, 8.0
# Errors of points in neighbouring rows differ by less than those of any two, by so many standard
# deviations, where it is the row that moves them.
_WITH_ROWS = 3.0
# Velocities beyond doubt, in squared standard deviations (four times the 99 % quantile of six), of
# which the prior knows less than this part: typical speeds are not weighed.
_CLEARLY_MOVING, _LITTLE_OF_THE_PRIOR = 67.0, 0.05


class Look(NamedTuple):
    """The best motion alone, and what it leaves."""

    best: Best
    lines: Lines
    planar: bool
    depth: float  # m
    near_outliers: int
    moving: bool  # neither rest nor another typical speed would change anything


@entry
def first_look(
    data: Out[Array2], points: Array2, start: Array1, terms: PriorTerms, threshold: float,
    rolling: bool,
    turn_known: bool,
) -> Look:  # fmt: skip
    """The best motion near a state (24,), and what tells whether it is all."""
    best = best_motion(data, len(points), start, terms, threshold)
    if not best.smallest_eigenvalue > LEAST_EIGENVALUE:
        lines = linearized(data, len(points), start, np.zeros((len(points), 6)))
        return Look(best, lines, False, NEAREST, 0, False)
    depth = median_depth(data, best.state, best.inliers)
    if not depth > NEAREST:  # NaN: there are no inliers
        depth = NEAREST
    lines = linearized(data, len(points), best.state, np.zeros((len(points), 6)))
    near = 0
    if rolling:
        near = near_outliers(lines, best.squared_errors, best.inliers, threshold)
    return Look(
        best, lines, plane_of(points, best.inliers)[0], depth, near,
        _clearly_moving(best, terms, turn_known),
    )  # fmt: skip


@entry
def near_outliers(
    lines: Lines, squared_errors: Array1, inliers: BoolArray1, threshold: float
) -> int:
    """Points just beyond the gate, where they are too many to be chance and it is the row that
    moves them; else 0.

    A part of the points that is shifted alike is another group of points, whatever its rows.
    """
    within = squared_errors < (_NEAR_GATE * threshold) ** 2
    count = int(np.count_nonzero(within & ~inliers))
    most = np.count_nonzero(inliers)
    shaken = count > _MARKER or most < 4 * _MARKER
    if not (shaken and count >= _NEAR_PART * most):
        return 0
    return count if _go_with_rows(lines, within) > _WITH_ROWS else 0


@kernel
def _go_with_rows(lines: Lines, chosen: BoolArray) -> float:
    """How much less the errors of neighbouring rows differ than those of any two rows, standard
    normal if the row does not matter (von Neumann 1941).
    """
    order, count, mean = np.argsort(lines.tau), 0, np.zeros(2)
    for i in order:
        if chosen[i]:
            mean += lines.errors[i]
            count += 1
    mean /= max(count, 1)
    spread, steps, previous = 0.0, 0.0, -1
    for i in order:
        if not chosen[i]:
            continue
        for k in range(2):
            spread += (lines.errors[i, k] - mean[k]) ** 2
            if previous >= 0:
                steps += 0.5 * (lines.errors[i, k] - lines.errors[previous, k]) ** 2
        previous = i
    if count < 4 or not spread > 0.0:
        return 0.0
    return (1.0 - steps / spread) * math.sqrt(float(count))


@inlined
def _clearly_moving(best: Best, terms: PriorTerms, turn_known: bool) -> bool:
    """True if neither rest nor another typical speed would change anything."""
    first = LINEAR.start if turn_known else VELOCITIES.start  # of the others a gyroscope knows
    spread = best.covariance[first : VELOCITIES.stop, first : VELOCITIES.stop].copy()
    information, part, squared = inverted(spread), 0.0, 0.0
    velocities = best.state[6 + first : 6 + VELOCITIES.stop]  # a state's pose is longer by six
    for i in range(len(spread)):
        part += terms.informations[0, first + i, first + i] * spread[i, i]
        for j in range(len(spread)):
            squared += velocities[i] * information[i, j] * velocities[j]
    return part < _LITTLE_OF_THE_PRIOR and squared > _CLEARLY_MOVING
