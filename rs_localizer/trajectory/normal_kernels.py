# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The normal equations of keypoints along a spline, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.simd.jit import kernel
from rs_localizer.trajectory.sight_kernels import (
    Curve,
    Row,
    Sights,
    Terms,
    differentiate,
    make_row,
)
from rs_localizer.trajectory.spline_kernels import CONTROL, LOCAL, ORDER


class Accelerations(NamedTuple):
    """What is expected of the accelerations at the controls.

    In each stretch a stationary first-order Markov process (Singer, see
    :mod:`rs_localizer.tracking`), or independent ones.
    """

    angular: float  # rad/s^2, standard deviation of each component
    linear: float  # m/s^2
    memory: float  # correlation of neighbouring controls; 0: they are independent


@kernel
def eliminate_stamps(normal: Normal) -> None:
    """Take what the images' own times explain out of the normal equations."""
    width, borders = normal.image_controls.shape[1], normal.image_border.shape[1]
    for g in range(len(normal.image_first)):
        share = 1.0 / normal.image_information[g]
        base, slope = CONTROL * normal.image_first[g], normal.image_slope[g]
        for a in range(width):
            x = share * normal.image_controls[g, a]
            if x == 0.0:
                continue
            normal.slope[base + a] -= x * slope
            for b in range(a + 1):
                normal.band[a - b, base + b] -= x * normal.image_controls[g, b]
            for k in range(borders):
                normal.cross[base + a, k] -= x * normal.image_border[g, k]
        for k in range(borders):
            x = share * normal.image_border[g, k]
            if x == 0.0:
                continue
            normal.border_slope[k] -= x * slope
            for j in range(k + 1):
                normal.corner[k, j] -= x * normal.image_border[g, j]


class Change(NamedTuple):
    """By how much the acceleration at a control is not what the one before lets expect.

    Times the square of the spacing; and its derivatives by the controls from two before to one
    behind it.
    """

    turn: Array  # (3,) body axes
    way: Array  # (3,) along the map's axes
    by_turn: Array  # (3,12) of the four controls' turns
    by_way: Array  # (4,) of their places


@kernel
def no_change() -> Change:
    """Room for one change after the other."""
    return Change(np.empty(3), np.empty(3), np.empty((3, 3 * ORDER)), np.empty(ORDER))


@kernel
def _change(curve: Curve, k: int, memory: float, change: Change) -> None:
    """Fill the change at control k. Without memory the controls before k - 1 need not be there."""
    change.turn[:] = 0.0
    change.way[:] = 0.0
    change.by_turn[:] = 0.0
    change.by_way[:] = 0.0
    for back in range(2 if memory > 0.0 else 1):
        share, at, column = (-memory, k - 1, 0) if back == 1 else (1.0, k, 3)
        before, after = curve.inverses[at], curve.inverses[at + 1]
        for i in range(3):
            change.turn[i] += share * (curve.vectors[at + 1, i] - curve.vectors[at, i])
            change.way[i] += share * (
                curve.positions[at - 1, i]
                - 2.0 * curve.positions[at, i]
                + curve.positions[at + 1, i]
            )
            for j in range(3):
                change.by_turn[i, column + j] += share * before[j, i]
                change.by_turn[i, column + 3 + j] -= share * (before[i, j] + after[j, i])
                change.by_turn[i, column + 6 + j] += share * after[i, j]
        change.by_way[1 - back] += share
        change.by_way[2 - back] -= 2.0 * share
        change.by_way[3 - back] += share


@kernel
def add_accelerations(
    curve: Curve, firsts: IntArray, expected: Accelerations, normal: Normal
) -> float:
    """Add the prior of the accelerations at the controls, of zero mean; returns its cost."""
    change = no_change()
    cost = 0.0
    for stretch in range(len(firsts) - 1):
        for k in range(firsts[stretch] + 1, firsts[stretch + 1] - 1):
            begins = 1 if k == firsts[stretch] + 1 else 0
            memory = 0.0 if begins else expected.memory
            _change(curve, k, memory, change)
            left = curve.spacing**4 * (1.0 - memory * memory)
            by_angular = 1.0 / (expected.angular**2 * left)
            by_linear = 1.0 / (expected.linear**2 * left)
            base = CONTROL * (k - 2)
            for i in range(3):
                cost += by_angular * change.turn[i] ** 2 + by_linear * change.way[i] ** 2
                for a in range(3 * begins, 3 * ORDER):
                    row = base + CONTROL * (a // 3) + a % 3
                    x = by_angular * change.by_turn[i, a]
                    normal.slope[row] += x * change.turn[i]
                    for b in range(3 * begins, a + 1):
                        column = base + CONTROL * (b // 3) + b % 3
                        normal.band[row - column, column] += x * change.by_turn[i, b]
                for a in range(begins, ORDER):
                    row = base + CONTROL * a + 3 + i
                    x = by_linear * change.by_way[a]
                    normal.slope[row] += x * change.way[i]
                    for b in range(begins, a + 1):
                        column = base + CONTROL * b + 3 + i
                        normal.band[row - column, column] += x * change.by_way[b]
    return cost


@kernel
def changes(curve: Curve, firsts: IntArray, memory: float, covariances: Array, out: Array) -> None:
    """Sums over all controls with an acceleration, in units in which it has variance 1.

    Args:
        covariances: (m,24,24) of the four controls about each of them: from two before it on, of
            the first of a stretch from one before it on.
        out: (2,2) the squares of angular and linear changes; their variances.
    """
    change = no_change()
    out[:] = 0.0
    m = 0
    for stretch in range(len(firsts) - 1):
        for k in range(firsts[stretch] + 1, firsts[stretch + 1] - 1):
            begins = 1 if k == firsts[stretch] + 1 else 0
            own = 0.0 if begins else memory
            _change(curve, k, own, change)
            scale = 1.0 / (curve.spacing**4 * (1.0 - own * own))
            for i in range(3):
                out[0, 0] += scale * change.turn[i] ** 2
                out[0, 1] += scale * change.way[i] ** 2
                for a in range(3 * begins, 3 * ORDER):
                    row = CONTROL * (a // 3 - begins) + a % 3
                    for b in range(3 * begins, 3 * ORDER):
                        column = CONTROL * (b // 3 - begins) + b % 3
                        out[1, 0] += (
                            scale * change.by_turn[i, a] * change.by_turn[i, b]
                            * covariances[m, row, column]
                        )  # fmt: skip
                for a in range(begins, ORDER):
                    row = CONTROL * (a - begins) + 3 + i
                    for b in range(begins, ORDER):
                        column = CONTROL * (b - begins) + 3 + i
                        out[1, 1] += (
                            scale
                            * change.by_way[a]
                            * change.by_way[b]
                            * covariances[m, row, column]
                        )
            m += 1


@kernel
def add_rest(curve: Curve, controls: IntArray, angular: float, linear: float,
             normal: Normal) -> float:  # fmt: skip
    """Add a zero-mean prior (rad/s, m/s) of the velocity after controls (k,); its cost."""
    by_turn = np.empty((3, 6))
    angular_precision = (curve.spacing * angular) ** -2
    linear_precision = (curve.spacing * linear) ** -2
    cost = 0.0
    for k in controls:
        turned, inverse = curve.vectors[k + 1], curve.inverses[k + 1]
        base = CONTROL * k
        for i in range(3):
            for j in range(3):
                by_turn[i, j] = -inverse[j, i]
                by_turn[i, 3 + j] = inverse[i, j]
        for i in range(3):
            cost += angular_precision * turned[i] * turned[i]
            for a in range(6):
                row = base + CONTROL * (a // 3) + a % 3
                x = angular_precision * by_turn[i, a]
                normal.slope[row] += x * turned[i]
                for b in range(a + 1):
                    column = base + CONTROL * (b // 3) + b % 3
                    normal.band[row - column, column] += x * by_turn[i, b]
            moved = curve.positions[k + 1, i] - curve.positions[k, i]
            cost += linear_precision * moved * moved
            before, after = base + 3 + i, base + CONTROL + 3 + i
            normal.slope[before] -= linear_precision * moved
            normal.slope[after] += linear_precision * moved
            normal.band[0, before] += linear_precision
            normal.band[0, after] += linear_precision
            normal.band[CONTROL, before] -= linear_precision
    return cost


class Normal(NamedTuple):
    """Normal equations: a band for the controls, a dense border for what all images share.

    What the stamp of each image is off (one number) stands beside them until it is eliminated; it
    touches the w controls that act during the image.
    """

    band: Array  # (6 w, 6 n) lower band, as LAPACK stores it
    cross: Array  # (6 n, b)
    corner: Array  # (b, b) lower triangle
    slope: Array  # (6 n,)
    border_slope: Array  # (b,)
    image_first: IntArray  # (g,) first control of each image
    image_controls: Array  # (g, 6 w)
    image_border: Array  # (g, b)
    image_information: Array  # (g,)
    image_slope: Array  # (g,)


@kernel
def border_of(sights: Sights, terms: Terms, n: int, row: Row, columns: IntArray,
               border: Array) -> int:  # fmt: skip
    """Fill the border's columns that keypoint n touches, and derivatives (2,...); how many."""
    count = len(row.by_shared[0])
    for k in range(count):
        columns[k] = k
        border[0, k], border[1, k] = row.by_shared[0, k], row.by_shared[1, k]
    slot = sights.slots[n] if terms.point_column >= 0 else -1
    if slot < 0:
        return count
    base, arm = terms.point_column + terms.point_width * slot, sights.arms[n]
    for i in range(3):
        columns[count + i] = base + i
        for r in range(2):
            border[r, count + i] = row.by_landmark[r, i]
    if terms.point_width == 3:
        return count + 3
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        columns[count + 3 + i] = base + 3 + i
        for r in range(2):
            g = row.by_landmark[r]
            border[r, count + 3 + i] = arm[a] * g[b] - arm[b] * g[a]
    return count + 6


@kernel
def accumulate(curve: Curve, sights: Sights, terms: Terms, normal: Normal) -> float:
    """Add the keypoints' part to the normal equations; returns its cost."""
    row = make_row(sights, terms)
    rows, error, late = row.by_controls, row.error, row.by_time
    most = row.by_shared.shape[1] + 6
    columns, border = np.empty(most, np.int64), np.empty((2, most))
    cost = 0.0
    for n in range(len(sights.first)):
        weight, spent = differentiate(curve, sights, terms, n, row)
        cost += spent
        if weight == 0.0:
            continue
        count, image = border_of(sights, terms, n, row, columns, border), sights.frames[n]
        base = CONTROL * sights.first[n]
        for a in range(LOCAL):
            x, y = weight * rows[0, a], weight * rows[1, a]
            normal.slope[base + a] += x * error[0] + y * error[1]
            for b in range(a + 1):
                normal.band[a - b, base + b] += x * rows[0, b] + y * rows[1, b]
            for k in range(count):
                normal.cross[base + a, columns[k]] += x * border[0, k] + y * border[1, k]
            if terms.stamps_free:
                place = base + a - CONTROL * normal.image_first[image]
                normal.image_controls[image, place] += x * late[0] + y * late[1]
        if terms.stamps_free:
            x, y = weight * late[0], weight * late[1]
            normal.image_information[image] += x * late[0] + y * late[1]
            normal.image_slope[image] += x * error[0] + y * error[1]
            for k in range(count):
                normal.image_border[image, columns[k]] += x * border[0, k] + y * border[1, k]
        for k in range(count):
            x, y = weight * border[0, k], weight * border[1, k]
            normal.border_slope[columns[k]] += x * error[0] + y * error[1]
            for j in range(k + 1):  # columns rise
                normal.corner[columns[k], columns[j]] += x * border[0, j] + y * border[1, j]
    return cost
