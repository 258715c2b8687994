# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Small linear algebra of numbers or lanes: vectors of three, least squares, rotations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rs_localizer.core.simd.tracing import Vector, select, sqrt


def dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """Return the scalar product of two vectors of equal length."""
    total: Any = 0.0
    for x, y in zip(a, b, strict=True):
        total = x * y + total
    return total


def cross(a: Sequence[Any], b: Sequence[Any]) -> Vector:
    """Return the vector product of two 3-vectors."""
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def multiply(matrix: Sequence[Sequence[Any]], vector: Sequence[Any]) -> Vector:
    """Multiply a matrix, given as a list of rows, and a vector."""
    return [dot(row, vector) for row in matrix]


def triangularize(columns: list[Vector], count: int) -> None:
    """Reflect columns in place so that the first ``count`` are upper triangular (Householder QR).

    ``columns`` are equally long lists; all of them are reflected. Entries below the diagonal of
    the first ``count`` columns are left undefined. A column without length below its diagonal
    (a rank-deficient system) gives NaN.
    """
    rows = len(columns[0])
    for k in range(min(count, rows - 1)):
        pivot = columns[k]
        head, tail = pivot[k], pivot[k + 1 :]
        norm = sqrt(head * head + dot(tail, tail))
        diagonal = select(head < 0.0, norm, -norm)  # the sign that avoids cancellation
        first = head - diagonal
        scale = 1.0 / (diagonal * first)
        pivot[k] = diagonal
        for column in columns[k + 1 :]:
            factor = (first * column[k] + dot(tail, column[k + 1 :])) * scale
            column[k] = column[k] + first * factor
            for i, value in enumerate(tail, k + 1):
                column[i] = column[i] + value * factor


def back_substitute(columns: Sequence[Vector], right: Sequence[Any]) -> Vector:
    """Solve ``sum_j columns[j] x_j = right`` for upper triangular columns."""
    right = list(right)
    solution: Vector = [0.0] * len(columns)
    for k in reversed(range(len(columns))):
        solution[k] = right[k] / columns[k][k]
        for i in range(k):
            right[i] = right[i] - columns[k][i] * solution[k]
    return solution


def least_squares(columns: list[Vector], right: Vector) -> Vector:
    """Solve ``sum_j columns[j] x_j = right`` in the least-squares sense, by Householder QR."""
    system = [*[list(column) for column in columns], list(right)]
    triangularize(system, len(columns))
    return back_substitute(system[:-1], system[-1])


def nearest_rotation(v: Sequence[Any]) -> list[Vector]:
    """Return the rotation by ``atan |v|`` about ``v``, the polar factor of ``I + [v]x``."""
    x, y, z = v
    q = 1.0 / sqrt(dot(v, v) + 1.0)
    c = q * q / (q + 1.0)
    sx, sy, sz = q * x, q * y, q * z
    return [
        [1.0 - c * (y * y + z * z), c * x * y - sz, c * x * z + sy],
        [c * x * y + sz, 1.0 - c * (x * x + z * z), c * y * z - sx],
        [c * x * z - sy, c * y * z + sx, 1.0 - c * (x * x + y * y)],
    ]
