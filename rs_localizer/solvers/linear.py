# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The equations that all linear rolling-shutter solvers share.

Double-linearized model of Kukelova, Albl, Sugimoto, Pajdla, "Linear solution to the minimal
absolute pose rolling shutter problem", ACCV 2018, eq. (5), with ``r`` the row time:

    lambda x = (I + r [w]x) (I + [v]x) X + C + r t

Rows ``(-1, 0, a)`` and ``(0, -1, b)`` of ``[x]x`` for ``x = (a, b, 1)`` give two equations per
point. ``C_x, t_x`` occur only in the first kind, ``C_y, t_y`` only in the second, and with the
same coefficients ``1, r``. So one orthogonal transformation of the rows, which depends on the row
times only, removes these four unknowns from all but the first two equations of either kind.
Being orthogonal, it leaves the least-squares solution as it is.
"""

from __future__ import annotations

from collections.abc import Sequence

from rs_localizer.core.simd.algebra import (
    back_substitute,
    least_squares,
    multiply,
    nearest_rotation,
    triangularize,
)
from rs_localizer.core.simd.tracing import Vector

Column = tuple[Vector, Vector]  # coefficients of one unknown in the equations of either kind


def lateral_column(count: int) -> Vector:
    """Return the coefficients of ``C_x`` in the first kind of equations, ``C_y`` in the second."""
    return [-1.0] * count


def rotation_columns(points: Sequence[Vector], rays: Sequence[Vector]) -> list[Column]:
    """Return coefficients of a vector u that enters as ``u x P``, P points of the camera frame."""
    first: list[Vector] = []
    second: list[Vector] = []
    for (x, y, z), (a, b) in zip(points, rays, strict=True):
        first.append([a * y, -z - a * x, y])
        second.append([b * y + z, -(b * x), -x])
    return [([row[k] for row in first], [row[k] for row in second]) for k in range(3)]


def depth_column(rays: Sequence[Vector]) -> Column:
    """Return the coefficients of a translation along z."""
    return [a for a, _ in rays], [b for _, b in rays]


def right_hand_side(points: Sequence[Vector], rays: Sequence[Vector]) -> Column:
    """Return the right-hand side of the equations: what the points themselves contribute."""
    return (
        [x - a * z for (x, _, z), (a, _) in zip(points, rays, strict=True)],
        [y - b * z for (_, y, z), (_, b) in zip(points, rays, strict=True)],
    )


def times_row(column: Column, tau: Vector) -> Column:
    """Return a column multiplied by the row times."""
    return (
        [r * value for r, value in zip(tau, column[0], strict=True)],
        [r * value for r, value in zip(tau, column[1], strict=True)],
    )


def minus(left: Column, right: Column) -> Column:
    """Return the difference of two columns."""
    return difference(left[0], right[0]), difference(left[1], right[1])


def difference(left: Vector, right: Vector) -> Vector:
    """Return the difference of two vectors."""
    return [x - y for x, y in zip(left, right, strict=True)]


def solve(
    lateral: Sequence[Vector], columns: Sequence[Column], right: Column
) -> tuple[Vector, Vector, Vector]:
    """Solve least squares with unknowns that occur in one kind of equation only.

    Args:
        lateral: coefficients of the unknowns that have one copy per kind (``C_x, t_x`` in the
            first kind and ``C_y, t_y`` in the second), common to both kinds.
        columns: coefficients of the unknowns that occur in both kinds.
        right: right-hand side.

    Returns:
        lateral unknowns of the first kind, those of the second kind, the common unknowns.
    """
    count = len(lateral)
    if not lateral:
        return [], [], least_squares([f + s for f, s in columns], right[0] + right[1])
    firsts = [list(column[0]) for column in [*columns, right]]
    seconds = [list(column[1]) for column in [*columns, right]]
    bases = [list(column) for column in lateral]
    triangularize([*bases, *firsts, *seconds], count)
    reduced = [f[count:] + s[count:] for f, s in zip(firsts, seconds, strict=True)]
    common = least_squares(reduced[:-1], reduced[-1])

    def lateral_unknowns(kind: list[Vector]) -> Vector:
        rest = list(kind[-1][:count])
        for column, value in zip(kind[:-1], common, strict=True):
            rest = [x - c * value for x, c in zip(rest, column[:count], strict=True)]
        return back_substitute(bases, rest)

    return lateral_unknowns(firsts), lateral_unknowns(seconds), common


def fold(rotation: Sequence[Vector], v: Vector) -> list[Vector]:
    """Return the initial rotation followed by the rotation nearest to ``I + [v]x``."""
    turn = nearest_rotation(v)
    columns = [multiply(turn, [row[j] for row in rotation]) for j in range(3)]
    return [[columns[j][i] for j in range(3)] for i in range(3)]
