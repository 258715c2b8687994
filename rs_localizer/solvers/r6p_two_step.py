# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""R6P in two alternating linear steps: vc_wt, vct_w and vct_wt.

    lambda x = (I + r [w]x) (I + [v]x) X + C + r t

of Kukelova, Albl, Sugimoto, Pajdla, ACCV 2018, sec. 3. Either step is an overdetermined linear
system of the twelve equations of six points, solved by least squares; w = t = 0 at the start.
Points are in the frame of the initial rotation; one solution.

    vc_wt    v, C given w, t        then  w, t given v, C
    vct_w    v, C, t given w        then  w given v, C, t
    vct_wt   v, C, t given w        then  w, t given v, C
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, Array3, IntArray2, Out
from rs_localizer.core.simd.algebra import cross
from rs_localizer.core.simd.tracing import LANES, Lanes, Vector, traced
from rs_localizer.native import entry, kernel
from rs_localizer.solvers import linear
from rs_localizer.solvers.batch import Sample, converged, gather, inputs, scatter

SAMPLE_SIZE = 6
SOLUTIONS = 1

_INPUTS = inputs(SAMPLE_SIZE)
_STATE = 13  # C, w, t, v, and the square of the last step
_MODEL = _INPUTS - 9
_CHANGE = _INPUTS + _STATE - 1
_SIZE = (_INPUTS + _STATE) * LANES


def _swung_rotation_columns(sample: Sample, w: Vector) -> list[linear.Column]:
    """Return coefficients of v in ``(I + r [w]x) (v x X)``, the equations from rotated rows."""
    first: list[Vector] = []
    second: list[Vector] = []
    for x, (a, b), r in zip(sample.points, sample.rays, sample.tau, strict=True):
        for rows, q in ((first, [-1.0, 0.0, a]), (second, [0.0, -1.0, b])):
            turned = [u - r * d for u, d in zip(q, cross(w, q), strict=True)]
            rows.append(cross(x, turned))
    return [([row[k] for row in first], [row[k] for row in second]) for k in range(3)]


def _turned(sample: Sample, v: Vector) -> list[Vector]:
    """Return ``X + v x X``."""
    return [[p + d for p, d in zip(x, cross(v, x), strict=True)] for x in sample.points]


def _at_rows(sample: Sample, points: list[Vector], w: Vector) -> list[Vector]:
    """Return ``P + r w x P``."""
    return [
        [p + r * d for p, d in zip(x, cross(w, x), strict=True)]
        for x, r in zip(points, sample.tau, strict=True)
    ]


def _translation_column(sample: Sample, vector: Vector) -> linear.Column:
    """Return ``q . vector`` for both kinds of equations."""
    x, y, z = vector
    return [a * z - x for a, _ in sample.rays], [b * z - y for _, b in sample.rays]


def _first_step(sample: Sample, w: Vector, t: Vector | None) -> tuple[Vector, Vector, Vector]:
    """Return v, C and t for a given w, and for a given t unless it is None."""
    rays, tau = sample.rays, sample.tau
    depth = linear.depth_column(rays)
    right = linear.right_hand_side(_at_rows(sample, sample.points, w), rays)
    columns = [*_swung_rotation_columns(sample, w), depth]
    lateral = [linear.lateral_column(SAMPLE_SIZE)]
    if t is not None:
        right = linear.minus(right, linear.times_row(_translation_column(sample, t), tau))
    else:
        columns.append(linear.times_row(depth, tau))
        lateral.append([-r for r in tau])
    x, y, common = linear.solve(lateral, columns, right)
    translations = [[x[k], y[k], common[3 + k]] for k in range(len(lateral))]
    return common[:3], translations[0], t if t is not None else translations[1]


def _second_step(sample: Sample, v: Vector, c: Vector, t: Vector | None) -> tuple[Vector, Vector]:
    """Return w and t for given v and C, and for a given t unless it is None."""
    rays, tau = sample.rays, sample.tau
    turned = _turned(sample, v)
    right = linear.minus(linear.right_hand_side(turned, rays), _translation_column(sample, c))
    columns = [linear.times_row(column, tau) for column in linear.rotation_columns(turned, rays)]
    if t is not None:
        right = linear.minus(right, linear.times_row(_translation_column(sample, t), tau))
        return linear.solve([], columns, right)[2], t
    columns.append(linear.times_row(linear.depth_column(rays), tau))
    (tx,), (ty,), common = linear.solve([[-r for r in tau]], columns, right)
    return common[:3], [tx, ty, common[3]]


def _step(values: list[Lanes], *, t_in_first: bool, t_in_second: bool) -> Vector:
    sample = Sample(values, SAMPLE_SIZE)
    w, t = sample.state[3:6], sample.state[6:9]
    v, c, t = _first_step(sample, w, None if t_in_first else t)
    w, t = _second_step(sample, v, c, None if t_in_second else t)
    changes = [linear.difference(*of) for of in ((v, sample.state[9:12]), (w, sample.state[3:6]))]
    return sample.stepped(sample.points, sample.rotation, [*c, *w, *t, *v], *changes)


def _end(values: list[Lanes]) -> Vector:
    sample = Sample(values, SAMPLE_SIZE)
    rotation = linear.fold(sample.rotation, sample.state[9:12])
    return sample.with_results(sample.points, rotation, sample.state)


def _begin(values: list[Lanes]) -> Vector:
    sample = Sample(values, SAMPLE_SIZE)
    return sample.with_results(sample.rotated_points(), sample.rotation, [0.0] * 12 + [1.0])


_begin_lanes = traced(_begin, _INPUTS)
_end_lanes = traced(_end, _INPUTS + _STATE)
_vc_wt_lanes = traced(
    lambda values: _step(values, t_in_first=False, t_in_second=True), _INPUTS + _STATE
)
_vct_w_lanes = traced(
    lambda values: _step(values, t_in_first=True, t_in_second=False), _INPUTS + _STATE
)
_vct_wt_lanes = traced(
    lambda values: _step(values, t_in_first=True, t_in_second=True), _INPUTS + _STATE
)


@kernel
def _alternate(
    points: Array, rays: Array, tau: Array, samples: Any, rotations: Array, iterations: int,
    models: Array, t_in_first: bool, t_in_second: bool,
) -> None:  # fmt: skip
    """Solve a batch by alternating steps; arguments as in :mod:`rs_localizer.solvers.batch`."""
    work = np.empty(_SIZE)
    for start in range(0, len(samples), LANES):
        gather(points, rays, tau, samples, rotations, start, work)
        _begin_lanes(work, work)
        for _ in range(iterations):
            if not t_in_first:
                _vc_wt_lanes(work, work)
            elif t_in_second:
                _vct_wt_lanes(work, work)
            else:
                _vct_w_lanes(work, work)
            if converged(work, _CHANGE):
                break
        _end_lanes(work, work)
        scatter(work, _MODEL, start, models[0])


@entry
def solve_vc_wt(
    points: Array2, rays: Array2, tau: Array1, samples: IntArray2, rotations: Array3,
    iterations: int, models: Out[Array3],
) -> None:  # fmt: skip
    """Solve a batch, v and C first; arguments as in :mod:`rs_localizer.solvers.batch`."""
    _alternate(points, rays, tau, samples, rotations, iterations, models, False, True)


@entry
def solve_vct_w(
    points: Array2, rays: Array2, tau: Array1, samples: IntArray2, rotations: Array3,
    iterations: int, models: Out[Array3],
) -> None:  # fmt: skip
    """Solve a batch, v, C and t first; arguments as in :mod:`rs_localizer.solvers.batch`."""
    _alternate(points, rays, tau, samples, rotations, iterations, models, True, False)


@entry
def solve_vct_wt(
    points: Array2, rays: Array2, tau: Array1, samples: IntArray2, rotations: Array3,
    iterations: int, models: Out[Array3],
) -> None:  # fmt: skip
    """Solve a batch, t in both steps; arguments as in :mod:`rs_localizer.solvers.batch`."""
    _alternate(points, rays, tau, samples, rotations, iterations, models, True, True)
