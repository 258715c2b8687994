# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""R6P: all solutions of the double-linearized rolling-shutter model for six points.

    lambda x = (I + r [w]x) (I + [v]x) X + C + r t

The polynomial solver that the linear ones are measured against: the system of Albl, Kukelova,
Pajdla, "R6P - Rolling shutter absolute camera pose", CVPR 2015, solved by a smaller elimination:

1. The translations are linear; an orthogonal transformation of the twelve equations removes
   them. Six remain, bilinear in v and w: ``A(v) [w; 1] = 0``, A 6x4 with linear entries.
2. A drops rank at up to 20 v, of which v_y are the eigenvalues of a 20x20 matrix
   (:mod:`rs_localizer.solvers.rank_drop`); only the real ones in range are followed up.
3. v follows from v_y, w from the null vector of A(v), and Newton steps on the six equations
   polish both; then C and t.

Six points in the frame of the initial rotation, any unit of length, |v| below a bound (|v| is the
tangent of the angle to the initial rotation); up to 20 solutions. The hidden variable is v_y; v_x
would do as well, while v_z, the turn about the optical axis, costs a digit of the eigenvalues.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, Array3, IntArray2, Out
from rs_localizer.core.simd.algebra import cross, dot, least_squares, triangularize
from rs_localizer.core.simd.eigenvalues import real_eigenvalues, reduce_to_hessenberg
from rs_localizer.core.simd.tracing import LANES, Lanes, Vector, select, traced
from rs_localizer.core.simd.vectors import lane_array
from rs_localizer.native import entry, inlined
from rs_localizer.solvers import linear, rank_drop
from rs_localizer.solvers.batch import MODEL_SIZE, Sample, gather, inputs, scatter
from rs_localizer.solvers.rank_drop import RELATIONS, SOLUTIONS

SAMPLE_SIZE = 6
# Largest |v|, 45 degrees from the initial rotation. Below it the solver finds everything that the
# authors' code finds. Solutions beyond it were never within 5 degrees of the truth (none of 248
# samples without other solutions, from initial rotations up to 25 degrees off, at up to 30 degrees
# per readout and 1 px).
BOUND = 1.0

_INPUTS = inputs(SAMPLE_SIZE)
_A = 6 * 4 * 4  # rows, columns (w and one constant), coefficients (constant and v)
_CANDIDATE = RELATIONS + 2  # relations, an eigenvalue, the bound
_SOLUTION = MODEL_SIZE + 3  # model, v
_NEWTON_STEPS = 2
_CONVERGED = 1e-7  # the longest last step; another one would be about its square


def _begin(values: list[Lanes]) -> Vector:
    """Return the rotated points and the coefficients of A(v)."""
    sample = Sample(values, SAMPLE_SIZE)
    points, rays, tau = sample.rotated_points(), sample.rays, sample.tau
    turned = linear.rotation_columns(points, rays)
    axes = ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    twice = [linear.rotation_columns([cross(e, x) for x in points], rays) for e in axes]
    entries = []  # of A: column by column, the coefficients of 1 and v
    for j in range(3):
        by_v = [twice[i][j] for i in range(3)]
        entries += [linear.times_row(column, tau) for column in (turned[j], *by_v)]
    right = linear.right_hand_side(points, rays)
    entries += [([-x for x in right[0]], [-y for y in right[1]]), *turned]
    depth = linear.depth_column(rays)
    columns = [depth, linear.times_row(depth, tau), *entries]
    # C_x and t_x occur in the first kind of equations only, C_y and t_y in the second.
    lateral = [linear.lateral_column(SAMPLE_SIZE), [-r for r in tau]]
    firsts, seconds = [list(first) for first, _ in columns], [list(second) for _, second in columns]
    triangularize([*lateral, *firsts, *seconds], 2)
    reduced = [f[2:] + s[2:] for f, s in zip(firsts, seconds, strict=True)]
    triangularize(reduced, 2)
    a = [column[2 + row] for row in range(6) for column in reduced[2:]]
    return sample.with_results(points, sample.rotation, a)


def _polish(a: list[list[Vector]], v: Vector) -> tuple[Vector, Vector, Any]:
    """Return the newton steps on ``A(v) [w; 1] = 0``: v, w, and the square of the last step."""

    def matrix(v: Vector) -> list[Vector]:
        return [[entry[0] + dot(entry[1:], v) for entry in row] for row in a]

    rows = matrix(v)
    w = least_squares([[row[j] for row in rows] for j in range(3)], [-row[3] for row in rows])
    step: Vector = []
    for _ in range(_NEWTON_STEPS):
        residual = [dot(row[:3], w) + row[3] for row in rows]
        by_v = [
            [dot([entry[1 + i] for entry in row[:3]], w) + row[3][1 + i] for row in a]
            for i in range(3)
        ]
        by_w = [[row[j] for row in rows] for j in range(3)]
        step = least_squares([*by_v, *by_w], residual)
        v = [x - d for x, d in zip(v, step[:3], strict=True)]
        w = [x - d for x, d in zip(w, step[3:], strict=True)]
        rows = matrix(v)
    return v, w, dot(step, step)


def _solution(values: list[Lanes]) -> Vector:
    """Return the model of one eigenvalue, and v; NaN where it is none."""
    sample = Sample(values[: _INPUTS + _A], SAMPLE_SIZE)
    relations, (y, bound) = values[-_CANDIDATE:-2], values[-2:]
    a = [[sample.state[16 * i + 4 * j : 16 * i + 4 * j + 4] for j in range(4)] for i in range(6)]
    v, w, change = _polish(a, rank_drop.solution_at(relations, y))
    valid = (change < _CONVERGED**2) & (dot(v, v) < bound * bound)
    v = [select(valid, x, math.nan) for x in v]
    points = []
    for x, r in zip(sample.points, sample.tau, strict=True):
        seen = [p + d for p, d in zip(x, cross(v, x), strict=True)]
        points.append([p + r * d for p, d in zip(seen, cross(w, seen), strict=True)])
    depth = linear.depth_column(sample.rays)
    (cx, tx), (cy, ty), (cz, tz) = linear.solve(
        [linear.lateral_column(SAMPLE_SIZE), [-r for r in sample.tau]],
        [depth, linear.times_row(depth, sample.tau)],
        linear.right_hand_side(points, sample.rays),
    )
    rotation = [x for row in linear.fold(sample.rotation, v) for x in row]
    return [*rotation, cx, cy, cz, *w, tx, ty, tz, *v]


_begin_lanes = traced(_begin, _INPUTS)
_solution_lanes = traced(_solution, _INPUTS + _A, _CANDIDATE)


@inlined
def _nearest_first(solutions: Array, count: int, lane: int) -> None:
    """Order a lane's solutions by length of v; those that are none, and NaN, come last."""
    for k in range(count):
        best, shortest = k, np.inf
        for j in range(k, count):
            v = (j * _SOLUTION + MODEL_SIZE) * LANES + lane
            length = solutions[v] ** 2 + solutions[v + LANES] ** 2 + solutions[v + 2 * LANES] ** 2
            if length < shortest:
                best, shortest = j, length
        if best == k:
            continue
        for i in range(lane, _SOLUTION * LANES, LANES):
            one, other = k * _SOLUTION * LANES + i, best * _SOLUTION * LANES + i
            solutions[one], solutions[other] = solutions[other], solutions[one]


@entry
def _solve(
    points: Array2, rays: Array2, tau: Array1, samples: IntArray2, rotations: Array3, bound: float,
    models: Out[Array3], turns: Out[Array3],
) -> None:  # fmt: skip
    """Solve a batch as :func:`solve_batch`; ``turns`` (20,3,h) gets v, or is empty (0,3,1)."""
    models[:] = np.nan
    work = lane_array(_INPUTS + _A)
    room = lane_array(rank_drop.WORK)
    candidate = lane_array(_CANDIDATE)
    multiplication = lane_array((SOLUTIONS + 1) ** 2)
    eigenvalues = lane_array(SOLUTIONS)
    counts = np.zeros(LANES, np.int64)
    solutions = lane_array(SOLUTIONS * _SOLUTION)
    candidate[-LANES:] = bound
    for start in range(0, len(samples), LANES):
        gather(points, rays, tau, samples, rotations, start, work)
        _begin_lanes(work, work)
        rank_drop.find_relations(work, _INPUTS, room, candidate)
        rank_drop.fill_multiplication(candidate, multiplication)
        reduce_to_hessenberg(multiplication, SOLUTIONS, room)
        real_eigenvalues(multiplication, SOLUTIONS, bound, room, counts, eigenvalues)
        count = counts.max()
        for k in range(count):
            for lane in range(LANES):
                value = eigenvalues[k * LANES + lane] if k < counts[lane] else np.nan
                candidate[RELATIONS * LANES + lane] = value
            _solution_lanes(work, candidate, solutions[k * _SOLUTION * LANES :])
        for lane in range(LANES):
            _nearest_first(solutions, count, lane)
        for k in range(count):
            scatter(solutions, k * _SOLUTION, start, models[k])
        for k in range(min(count, len(turns))):
            for lane in range(min(LANES, len(samples) - start)):
                for i in range(3):
                    turns[k, i, start + lane] = solutions[
                        (k * _SOLUTION + MODEL_SIZE + i) * LANES + lane
                    ]


def solve_batch(
    points: Array, rays: Array, tau: Array, samples: Any, rotations: Array, iterations: int,
    models: Array, bound: float = BOUND,
) -> None:  # fmt: skip
    """Solve a batch as in :mod:`rs_localizer.solvers.batch`, without iterations.

    Args:
        bound: of |v|.

    The solutions of a sample come first, those nearest to the initial rotation before others.
    """
    # Not a kernel itself: Numba would optimize all of the code once more.
    _solve(points, rays, tau, samples, rotations, float(bound), models, np.empty((0, 3, 1)))
