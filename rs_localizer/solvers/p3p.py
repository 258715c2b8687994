# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""P3P: the global-shutter pose of three points, the baseline of the rolling-shutter solvers.

    lambda_i y_i = R X_i + C,   |y_i| = 1

The depths satisfy three quadrics ``|lambda_i y_i - lambda_j y_j|^2 = |X_i - X_j|^2``. As in
Persson, Nordberg, "Lambda Twist: an accurate fast robust perspective three point (P3P) solver",
ECCV 2018, one real root of a cubic gives a degenerate conic of their pencil; its two lines meet
another conic in up to four points, and Newton steps on the three quadrics polish the depths. The
lines are split as in Richter-Gebert, "Perspectives on Projective Geometry", 2011, sec. 11.1.
Three points, up to four solutions; w = t = 0.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array1, Array2, Array3, IntArray2, Out
from rs_localizer.core.simd.algebra import cross, dot
from rs_localizer.core.simd.tracing import LANES, Lanes, Vector, select, sqrt, traced
from rs_localizer.native import entry
from rs_localizer.solvers.batch import MODEL_SIZE, Sample, gather, inputs, scatter

SAMPLE_SIZE = 3
SOLUTIONS = 4

_INPUTS = inputs(SAMPLE_SIZE)
# The start lies beyond the outermost extremum, where Newton's method gains digits at once.
_CUBIC_STEPS = 9
_DEPTH_STEPS = 2

Symmetric = tuple[Any, ...]  # 00, 01, 02, 11, 12, 22


def _adjugate(m: Symmetric) -> Symmetric:
    a, b, c, d, e, f = m
    return (
        d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b,
    )  # fmt: skip


def _trace_product(m: Symmetric, n: Symmetric) -> Any:
    off = m[1] * n[1] + m[2] * n[2] + m[4] * n[4]
    return m[0] * n[0] + m[3] * n[3] + m[5] * n[5] + off + off


def _real_root(c2: Any, c1: Any, c0: Any) -> Any:
    """Return a real root of ``x^3 + c2 x^2 + c1 x + c0``: the one outside its extrema."""
    discriminant = c2 * c2 - 3.0 * c1
    spread = sqrt(select(discriminant > 0.0, discriminant, 0.0))
    left = (-c2 - spread) / 3.0
    right = (-c2 + spread) / 3.0

    def value(x: Any) -> Any:
        return ((x + c2) * x + c1) * x + c0

    # Beyond an extremum e the cubic is f(e) + (3 e + c2) (x - e)^2 to second order.
    at_left, at_right = value(left), value(right)
    from_left = left - sqrt(-at_left / (3.0 * left + c2))
    from_right = right + sqrt(-at_right / (3.0 * right + c2))
    # Without extrema the cubic rises everywhere: start at the bound of its root's size.
    inflection = c2 / -3.0
    at_inflection = value(inflection)
    slope = c1 - c2 * c2 / 3.0
    plain = inflection - at_inflection / (slope + sqrt(sqrt(at_inflection * at_inflection)))
    x = select(discriminant > 0.0, select(at_left > 0.0, from_left, from_right), plain)
    for _ in range(_CUBIC_STEPS):
        x = x - value(x) / ((3.0 * x + (c2 + c2)) * x + c1)
    return x


def _lines(m: Symmetric) -> tuple[Vector, Vector]:
    """Return the two lines of a degenerate conic; NaN where they are not real."""
    full = [[m[0], m[1], m[2]], [m[1], m[3], m[4]], [m[2], m[4], m[5]]]
    a = [-value for value in _adjugate(m)]
    adjugate = [[a[0], a[1], a[2]], [a[1], a[3], a[4]], [a[2], a[4], a[5]]]
    best, column = adjugate[0][0], adjugate[0]
    for i in (1, 2):
        better = adjugate[i][i] > best
        best = select(better, adjugate[i][i], best)
        column = [select(better, x, y) for x, y in zip(adjugate[i], column, strict=True)]
    scale = 1.0 / sqrt(best)
    p = [value * scale for value in column]  # where the lines meet
    split = [
        [full[0][0], full[0][1] - p[2], full[0][2] + p[1]],
        [full[1][0] + p[2], full[1][1], full[1][2] - p[0]],
        [full[2][0] - p[1], full[2][1] + p[0], full[2][2]],
    ]
    # Rank one: any row is one line and any column the other; take them at the largest entry.
    row, largest = split[0], abs(split[0][0])
    line = [split[i][0] for i in range(3)]
    for i in range(3):
        for j in range(3):
            size = abs(split[i][j])
            better = size > largest
            largest = select(better, size, largest)
            row = [select(better, x, y) for x, y in zip(split[i], row, strict=True)]
            other = [split[k][j] for k in range(3)]
            line = [select(better, x, y) for x, y in zip(other, line, strict=True)]
    return row, line


def _polish(depths: Vector, cosines: Vector, squares: Vector) -> Vector:
    """Return depths (3) after Newton steps on the three quadrics (squares of sides 12, 13, 23)."""
    b12, b13, b23 = cosines
    x, y, z = depths
    for _ in range(_DEPTH_STEPS):
        f = [
            x * x + y * y - (b12 + b12) * x * y - squares[0],
            x * x + z * z - (b13 + b13) * x * z - squares[1],
            y * y + z * z - (b23 + b23) * y * z - squares[2],
        ]
        # Half the Jacobian: rows (p, q, 0), (r, 0, s), (0, t, u).
        p, q, r = x - b12 * y, y - b12 * x, x - b13 * z
        s, t, u = z - b13 * x, y - b23 * z, z - b23 * y
        scale = 0.5 / (p * s * t + q * r * u)
        dx = (s * t * f[0] + q * u * f[1] - q * s * f[2]) * scale
        dy = (r * u * f[0] - p * u * f[1] + p * s * f[2]) * scale
        dz = (p * t * f[1] + q * r * f[2] - r * t * f[0]) * scale
        x, y, z = x - dx, y - dy, z - dz
    return [x, y, z]


def _pose(depths: Vector, bearings: list[Vector], points: list[Vector]) -> tuple[Vector, Vector]:
    """Return rotation (row-major) and C that take the points to their places on the bearings."""
    seen = [[d * v for v in y] for d, y in zip(depths, bearings, strict=True)]

    def frame(corners: list[Vector]) -> list[Vector]:
        one = [a - b for a, b in zip(corners[1], corners[0], strict=True)]
        two = [a - b for a, b in zip(corners[2], corners[0], strict=True)]
        normal = cross(one, two)
        axes = one, cross(normal, one), normal
        scales = [1.0 / sqrt(dot(axis, axis)) for axis in axes]
        return [[v * scale for v in axis] for axis, scale in zip(axes, scales, strict=True)]

    # Depths of near and far points together are rounded; axes are orthonormal nevertheless.
    camera, own = frame(seen), frame(points)
    rotation = [
        [dot([axis[i] for axis in camera], [axis[j] for axis in own]) for j in range(3)]
        for i in range(3)
    ]
    moved = [dot(row, points[0]) for row in rotation]
    translation = [a - b for a, b in zip(seen[0], moved, strict=True)]
    return [x for row in rotation for x in row], translation


def _solve(values: list[Lanes]) -> Vector:
    sample = Sample(values, SAMPLE_SIZE)
    points = sample.points
    bearings = []
    for a, b in sample.rays:
        scale = 1.0 / sqrt(a * a + b * b + 1.0)
        bearings.append([a * scale, b * scale, scale])
    pairs = ((0, 1), (0, 2), (1, 2))
    b12, b13, b23 = cosines = [dot(bearings[i], bearings[j]) for i, j in pairs]
    sides = [[p - q for p, q in zip(points[i], points[j], strict=True)] for i, j in pairs]
    a12, a13, a23 = squares = [dot(side, side) for side in sides]
    # D1 = a23 M12 - a12 M23 and D2 = a23 M13 - a13 M23 span the pencil.
    d1 = (a23, -a23 * b12, 0.0, a23 - a12, a12 * b23, -a12)
    d2 = (a23, 0.0, -a23 * b13, -a13, a13 * b23, a23 - a13)
    adjugate1, adjugate2 = _adjugate(d1), _adjugate(d2)

    def determinant(m: Symmetric, adjugate: Symmetric) -> Any:
        return m[0] * adjugate[0] + m[1] * adjugate[1] + m[2] * adjugate[2]

    leading = 1.0 / determinant(d2, adjugate2)
    gamma = _real_root(
        _trace_product(adjugate2, d1) * leading,
        _trace_product(adjugate1, d2) * leading,
        determinant(d1, adjugate1) * leading,
    )
    conic = tuple(x + gamma * y for x, y in zip(d1, d2, strict=True))
    models: Vector = []
    for line in _lines(conic):
        # On the line lambda_1 = w0 lambda_2 + w1 lambda_3; with k = lambda_3 / lambda_2 the conic
        # a13 |12| = a12 |13| becomes a quadratic in k.
        w0, w1 = -line[1] / line[0], -line[2] / line[0]
        difference = a13 - a12
        qa = (difference * w1 + 2.0 * a12 * b13) * w1 - a12
        qb = difference * w0 * w1 - a13 * b12 * w1 + a12 * b13 * w0  # half the linear term
        qc = (difference * w0 - 2.0 * a13 * b12) * w0 + a13
        root = sqrt(qb * qb - qa * qc)
        q = -(qb + select(qb < 0.0, -root, root))
        for k in (q / qa, qc / q):
            second = sqrt(a23 / ((k - 2.0 * b23) * k + 1.0))
            depths = [(w0 + w1 * k) * second, second, k * second]
            valid = (depths[0] > 0.0) & (depths[2] > 0.0)
            depths[1] = select(valid, second, math.nan)
            rotation, translation = _pose(_polish(depths, cosines, squares), bearings, points)
            models += [*rotation, *translation, *[0.0] * 6]
    return models


_lanes = traced(_solve, _INPUTS)


@entry
def solve_batch(
    points: Array2, rays: Array2, tau: Array1, samples: IntArray2, rotations: Array3,
    iterations: int, models: Out[Array3],
) -> None:  # fmt: skip
    """Solve a batch as in :mod:`rs_localizer.solvers.batch`; no initial rotation is taken."""
    work = np.empty(_INPUTS * LANES)
    solutions = np.empty(SOLUTIONS * MODEL_SIZE * LANES)
    for start in range(0, len(samples), LANES):
        gather(points, rays, tau, samples, rotations, start, work)
        _lanes(work, solutions)
        for s in range(SOLUTIONS):
            scatter(solutions, s * MODEL_SIZE, start, models[s])
