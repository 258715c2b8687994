# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""R9P: the nine-point solver with a free matrix in place of the rotation rate; not iterative.

    lambda x = (I + [v]x) X + r R_RS X + C + r t

of Kukelova, Albl, Sugimoto, Pajdla, ACCV 2018, sec. 3.4: eighteen linear equations in v, C, t and
the nine entries of R_RS. Points are in the frame of the initial rotation; one solution.

At zero motion ``R_RS = I, t = C`` solves the homogeneous equations (all points scaled with the
row), so the published system is singular there. Fixing ``trace(R_RS) = 0``, which holds for the
true ``[w]x`` to first order, removes that direction; it is the default. Either way
``w`` is the skew part of ``R_RS (I + [v]x)^-1``: what else is in R_RS, and noise puts much there,
no rigid motion can follow. Scored by the model above, R9P fits far more points than by that motion.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, Array3, IntArray2, Out
from rs_localizer.core.simd.algebra import dot
from rs_localizer.core.simd.tracing import LANES, Lanes, Vector, traced
from rs_localizer.native import entry, kernel
from rs_localizer.solvers import linear
from rs_localizer.solvers.batch import MODEL_SIZE, Sample, gather, inputs, scatter

SAMPLE_SIZE = 9
SOLUTIONS = 1

_INPUTS = inputs(SAMPLE_SIZE)


def _angular_velocity(matrix: list[Vector], v: Vector) -> Vector:
    """Return the skew part of ``R_RS (I + [v]x)^-1``.

    The inverse is ``(I - [v]x + v v^T)/(1 + v.v)``.
    """
    x, y, z = v
    scale = 1.0 / (dot(v, v) + 1.0)
    inverse = [
        [x * x + 1.0, x * y + z, x * z - y],
        [x * y - z, y * y + 1.0, y * z + x],
        [x * z + y, y * z - x, z * z + 1.0],
    ]
    product = [[dot(row, [r[j] for r in inverse]) for j in range(3)] for row in matrix]
    half = 0.5 * scale
    return [
        (product[2][1] - product[1][2]) * half,
        (product[0][2] - product[2][0]) * half,
        (product[1][0] - product[0][1]) * half,
    ]


def unknowns(sample: Sample, *, fix_trace: bool) -> tuple[Vector, Vector, Vector, list[Vector]]:
    """Return v, C, t and the rows of R_RS in the frame of the initial rotation."""
    points, rays, tau = sample.rotated_points(), sample.rays, sample.tau
    depth = linear.depth_column(rays)
    swept = [[r * x[k] for x, r in zip(points, tau, strict=True)] for k in range(3)]
    lateral = [linear.lateral_column(SAMPLE_SIZE), [-r for r in tau]]
    # The first row of R_RS occurs in the first kind of equations only, the second row in the
    # second kind, with the same coefficients -r X: they are lateral unknowns like C_x and C_y.
    minus_swept = [[-value for value in column] for column in swept]
    third_row: list[linear.Column] = [
        (
            [a * value for value, (a, _) in zip(column, rays, strict=True)],
            [b * value for value, (_, b) in zip(column, rays, strict=True)],
        )
        for column in swept
    ]
    common_columns = [
        *linear.rotation_columns(points, rays),
        depth,
        linear.times_row(depth, tau),
    ]
    right = linear.right_hand_side(points, rays)
    zero: Vector = [0.0] * SAMPLE_SIZE
    if fix_trace:
        # R_33 = -(R_11 + R_22) couples the two kinds, so the first two rows become common.
        (r33_first, r33_second) = third_row[2]
        rows: list[linear.Column] = [
            linear.minus((minus_swept[0], zero), (r33_first, r33_second)),
            (minus_swept[1], zero),
            (minus_swept[2], zero),
            (zero, minus_swept[0]),
            linear.minus((zero, minus_swept[1]), (r33_first, r33_second)),
            (zero, minus_swept[2]),
        ]
        (cx, tx), (cy, ty), common = linear.solve(
            lateral, [*common_columns, *third_row[:2], *rows], right
        )
        matrix = [common[7:10], common[10:13], [*common[5:7], -(common[7] + common[11])]]
    else:
        first, second, common = linear.solve(
            [*lateral, *minus_swept], [*common_columns, *third_row], right
        )
        cx, tx, *row_one = first
        cy, ty, *row_two = second
        matrix = [row_one, row_two, common[5:8]]
    return common[:3], [cx, cy, common[3]], [tx, ty, common[4]], matrix


def _solve(values: list[Lanes], *, fix_trace: bool) -> Vector:
    sample = Sample(values, SAMPLE_SIZE)
    v, c, t, matrix = unknowns(sample, fix_trace=fix_trace)
    w = _angular_velocity(matrix, v)
    rotation = linear.fold(sample.rotation, v)
    return [*(x for row in rotation for x in row), *c, *w, *t]


_lanes = traced(lambda values: _solve(values, fix_trace=True), _INPUTS)
_lanes_as_published = traced(lambda values: _solve(values, fix_trace=False), _INPUTS)


@kernel
def _solve_each(
    points: Array, rays: Array, tau: Array, samples: Any, rotations: Array, models: Array,
    fix_trace: bool,
) -> None:  # fmt: skip
    """Solve a batch, trace fixed, with arguments as in :mod:`rs_localizer.solvers.batch`."""
    work = np.empty(_INPUTS * LANES)
    model = np.empty(MODEL_SIZE * LANES)
    for start in range(0, len(samples), LANES):
        gather(points, rays, tau, samples, rotations, start, work)
        if fix_trace:
            _lanes(work, model)
        else:
            _lanes_as_published(work, model)
        scatter(model, 0, start, models[0])


@entry
def solve_batch(
    points: Array2, rays: Array2, tau: Array1, samples: IntArray2, rotations: Array3,
    iterations: int, models: Out[Array3],
) -> None:  # fmt: skip
    """Solve a batch, trace fixed; arguments and result as in :mod:`rs_localizer.solvers.batch`."""
    _solve_each(points, rays, tau, samples, rotations, models, True)


@entry
def solve_batch_as_published(
    points: Array2, rays: Array2, tau: Array1, samples: IntArray2, rotations: Array3,
    iterations: int, models: Out[Array3],
) -> None:  # fmt: skip
    """Solve a batch, gauge free, as published; arguments as of :func:`solve_batch`."""
    _solve_each(points, rays, tau, samples, rotations, models, False)
