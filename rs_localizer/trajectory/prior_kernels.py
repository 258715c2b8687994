"""What stands in the normal equations beside the keypoints: smooth motion, own times of images."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import IntArray
from rs_localizer.core.lanes.jit import kernel
from rs_localizer.trajectory.normal_kernels import Normal
from rs_localizer.trajectory.sight_kernels import Curve
from rs_localizer.trajectory.spline_kernels import CONTROL, ORDER


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


@kernel
def add_smoothness(
    curve: Curve, firsts: IntArray, angular: float, linear: float, normal: Normal
) -> float:
    """Add a zero-mean prior of these deviations (rad/s^2, m/s^2) on the acceleration at each
    control; returns its cost.
    """
    by_turn = np.empty((3, 3 * ORDER - 3))
    error = np.empty(3)
    angular_precision = (curve.spacing**2 * angular) ** -2
    linear_precision = (curve.spacing**2 * linear) ** -2
    second = np.array([1.0, -2.0, 1.0])
    cost = 0.0
    for stretch in range(len(firsts) - 1):
        for k in range(firsts[stretch] + 1, firsts[stretch + 1] - 1):
            before, after = curve.inverses[k], curve.inverses[k + 1]
            for i in range(3):
                error[i] = curve.vectors[k + 1, i] - curve.vectors[k, i]
                for j in range(3):
                    by_turn[i, j] = before[j, i]
                    by_turn[i, 3 + j] = -before[i, j] - after[j, i]
                    by_turn[i, 6 + j] = after[i, j]
            base = CONTROL * (k - 1)
            for i in range(3):
                cost += angular_precision * error[i] * error[i]
                moved = (
                    curve.positions[k - 1, i]
                    - 2.0 * curve.positions[k, i]
                    + curve.positions[k + 1, i]
                )
                cost += linear_precision * moved * moved
                for a in range(9):
                    row = base + CONTROL * (a // 3) + a % 3
                    x = angular_precision * by_turn[i, a]
                    normal.slope[row] += x * error[i]
                    for b in range(a + 1):
                        column = base + CONTROL * (b // 3) + b % 3
                        normal.band[row - column, column] += x * by_turn[i, b]
                for a in range(3):
                    row = base + CONTROL * a + 3 + i
                    x = linear_precision * second[a]
                    normal.slope[row] += x * moved
                    for b in range(a + 1):
                        column = base + CONTROL * b + 3 + i
                        normal.band[row - column, column] += x * second[b]
    return cost


@kernel
def add_rest(curve: Curve, controls: IntArray, angular: float, linear: float,
             normal: Normal) -> float:  # fmt: skip
    """Add a zero-mean prior of these deviations (rad/s, m/s) on the velocity from each of some
    controls (k,) to the next; returns its cost.
    """
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
