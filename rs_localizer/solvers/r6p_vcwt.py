# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""R6P v,C,w,t: the six-point solver that is linear in all twelve unknowns at once.

    lambda x = (I + [v]x) X + r [w]x (I + [v^]x) X + C + r t

of Kukelova, Albl, Sugimoto, Pajdla, ACCV 2018, sec. 3 ("R6P_[v]x [v,C,w,t]"): only the v in the
product with w is fixed at its previous value v^. Points are in the frame of the initial
rotation; six points, twelve equations, one solution per iteration.

Relinearised (the default): every iteration turns the points by the rotation found so far and
starts again from v^ = 0. It costs the same and converges from tens of degrees, where freezing v^
("as published") needs a few.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, Array3, IntArray2, Out
from rs_localizer.core.simd.algebra import cross, multiply, nearest_rotation
from rs_localizer.core.simd.tracing import LANES, Lanes, Vector, traced
from rs_localizer.native import entry, kernel
from rs_localizer.solvers import linear
from rs_localizer.solvers.batch import Sample, converged, gather, inputs, scatter

SAMPLE_SIZE = 6
SOLUTIONS = 1

_INPUTS = inputs(SAMPLE_SIZE)
_STATE = 13  # C, w, t, v, and the square of the last step
_MODEL = _INPUTS - 9  # rotation, C, w, t lie side by side once v has been folded in
_CHANGE = _INPUTS + _STATE - 1


def _solve(sample: Sample, v: Vector | None) -> tuple[Vector, Vector, Vector, Vector]:
    """Return v, C, w, t with v^ in the product with w; None stands for v^ = 0."""
    points, rays, tau = sample.points, sample.rays, sample.tau
    rotation = linear.rotation_columns(points, rays)
    if v is None:
        turning = rotation
    else:
        turned = [[p + d for p, d in zip(x, cross(v, x), strict=True)] for x in points]
        turning = linear.rotation_columns(turned, rays)
    depth = linear.depth_column(rays)
    columns = [
        *rotation,
        *(linear.times_row(column, tau) for column in turning),
        depth,
        linear.times_row(depth, tau),
    ]
    lateral = linear.lateral_column(SAMPLE_SIZE)
    (cx, tx), (cy, ty), common = linear.solve(
        [lateral, [-r for r in tau]], columns, linear.right_hand_side(points, rays)
    )
    return common[0:3], [cx, cy, common[6]], common[3:6], [tx, ty, common[7]]


def _begin(values: list[Lanes]) -> Vector:
    sample = Sample(values, SAMPLE_SIZE)
    return sample.with_results(sample.rotated_points(), sample.rotation, [0.0] * 12 + [1.0])


def _relinearized_step(values: list[Lanes]) -> Vector:
    sample = Sample(values, SAMPLE_SIZE)
    v, c, w, t = _solve(sample, None)
    turn = nearest_rotation(v)
    points = [multiply(turn, x) for x in sample.points]
    change = linear.difference(w, sample.state[3:6])
    return sample.stepped(points, linear.fold(sample.rotation, v), [*c, *w, *t, *v], v, change)


def _frozen_step(values: list[Lanes]) -> Vector:
    sample = Sample(values, SAMPLE_SIZE)
    v, c, w, t = _solve(sample, sample.state[9:12])
    changes = [linear.difference(*of) for of in ((v, sample.state[9:12]), (w, sample.state[3:6]))]
    return sample.stepped(sample.points, sample.rotation, [*c, *w, *t, *v], *changes)


def _frozen_end(values: list[Lanes]) -> Vector:
    sample = Sample(values, SAMPLE_SIZE)
    return sample.with_results(
        sample.points, linear.fold(sample.rotation, sample.state[9:12]), sample.state
    )


_begin_lanes = traced(_begin, _INPUTS)
_relinearized_lanes = traced(_relinearized_step, _INPUTS + _STATE)
_frozen_lanes = traced(_frozen_step, _INPUTS + _STATE)
_frozen_end_lanes = traced(_frozen_end, _INPUTS + _STATE)


@kernel
def _iterate(
    points: Array, rays: Array, tau: Array, samples: Any, rotations: Array, iterations: int,
    models: Array, frozen: bool,
) -> None:  # fmt: skip
    """Solve a batch, relinearized, with arguments as in :mod:`rs_localizer.solvers.batch`."""
    work = np.empty((_INPUTS + _STATE) * LANES)
    for start in range(0, len(samples), LANES):
        gather(points, rays, tau, samples, rotations, start, work)
        _begin_lanes(work, work)
        for _ in range(iterations):
            if frozen:
                _frozen_lanes(work, work)
            else:
                _relinearized_lanes(work, work)
            if converged(work, _CHANGE):
                break
        if frozen:
            _frozen_end_lanes(work, work)
        scatter(work, _MODEL, start, models[0])


@entry
def solve_batch(
    points: Array2, rays: Array2, tau: Array1, samples: IntArray2, rotations: Array3,
    iterations: int, models: Out[Array3],
) -> None:  # fmt: skip
    """Solve a batch, relinearized; arguments as in :mod:`rs_localizer.solvers.batch`."""
    _iterate(points, rays, tau, samples, rotations, iterations, models, False)


@entry
def solve_batch_frozen(
    points: Array2, rays: Array2, tau: Array1, samples: IntArray2, rotations: Array3,
    iterations: int, models: Out[Array3],
) -> None:  # fmt: skip
    """Solve a batch with v^ frozen, as published; arguments as of :func:`solve_batch`."""
    _iterate(points, rays, tau, samples, rotations, iterations, models, True)
