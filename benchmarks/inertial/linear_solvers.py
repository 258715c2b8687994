# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Linear minimal solvers that know the turn rate, the vertical, or both; for comparison only.

The double-linearised model of Kukelova, Albl, Sugimoto, Pajdla (ACCV 2018),

    lambda x = (I + r [w]x) (I + [v]x) X + C + r t,

with ``w = 0`` on bearings that a gyroscope has turned row by row (9 unknowns, five points), with
``v`` along the known vertical (10 unknowns, five points: the problem of R5Pup, Albl, Kukelova,
Pajdla, CVPR 2016), or with both (7 unknowns, four points). ``[w]x [v]x`` is left out; the points
are rotated by what was found before the next iteration, where ``v`` is small.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.solvers.table import Solver


def linear_solver(
    size: int, *, turn_known: bool, vertical: tuple[Array, Array] | None = None
) -> Solver:
    """A solver of samples of this many points.

    Args:
        turn_known: the bearings do not turn.
        vertical: one direction (3,) in the map and in the camera.
    """
    solve = partial(_solve, turn_known, vertical)
    return Solver(solve, solve, size, 1, rolling_shutter=True)


def _solve(turn_known: bool, vertical: tuple[Array, Array] | None, *batch: Any) -> None:
    """``batch`` is what kernels take, see :mod:`rs_localizer.solvers.batch`."""
    points, rays, tau, samples, rotations, iterations, models = batch
    axes = np.eye(3) if vertical is None else vertical[1][:, None]
    rotation = np.broadcast_to(rotations, (len(samples), 3, 3))
    if vertical is not None:
        rotation = _onto(rotation[0] @ vertical[0], vertical[1]) @ rotation
    chosen, row = points[samples], tau[samples][:, :, None, None]
    first, second = rays[samples][..., :1], rays[samples][..., 1:]
    one, zero = np.ones_like(first), np.zeros_like(first)
    across = np.stack(  # two rows of [x]x
        [np.concatenate([-one, zero, first], -1), np.concatenate([zero, -one, second], -1)], 2
    )
    size = axes.shape[1]
    for _ in range(iterations):
        seen = np.einsum("hij,hnj->hni", rotation, chosen)
        by_turn = np.cross(seen[:, :, None], across)
        columns = [by_turn @ axes, across, row * across]
        if not turn_known:
            columns.append(row * by_turn)
        matrix = np.concatenate(columns, -1).reshape(len(samples), 2 * samples.shape[1], -1)
        right = -np.einsum("hnki,hni->hnk", across, seen).reshape(len(samples), -1)
        found = np.einsum("hui,hi->hu", np.linalg.pinv(matrix), right)
        rotation = so3.exp_many(found[:, :size] @ axes.T) @ rotation
    models[0, :9] = rotation.reshape(-1, 9).T
    models[0, 9:12] = found[:, size : size + 3].T
    models[0, 12:15] = 0.0 if turn_known else found[:, size + 6 :].T
    models[0, 15:18] = found[:, size + 3 : size + 6].T


def _onto(here: Array, there: Array) -> Array:
    """The least rotation (3,3) that carries a unit vector into another."""
    axis, cosine = np.cross(here, there), float(here @ there)
    length = float(np.linalg.norm(axis))
    if length == 0.0:
        return np.eye(3)
    return so3.exp(axis / length * float(np.arctan2(length, cosine)))
