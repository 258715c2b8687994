"""Gaussians of motions: those of a camera that turned about what it sees, and means of many.

The points say precisely in which direction they are and roughly how far away. A camera whose
orientation they hardly tell is somewhere on an arc about them, and arcs leave their tangents: by
half of 3 m times the square of 4 degrees, 7 mm, where the ellipsoid is thinner than 1 mm. In the
terms of a step (turn ``phi``, move ``rho``; see :mod:`rs_localizer.estimation.refine`), points at
``p`` in camera axes that move there by ``d`` are seen from

    rho = p - exp([phi]x) (p + d)
        = -d - phi x p - (phi x (phi x p) / 2 + phi x d) - ...

of which the ellipsoid has the first two. Arcs also turn the axes: a step from one point of an arc,
told from another one, moves along other axes.
"""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.blocks import write
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.so3 import exp
from rs_localizer.core.state import MOVE, PARAMETERS, TURN, step_between
from rs_localizer.estimation.refine import apply_step


@kernel
def along_arcs(covariance: Array, centre: Array) -> Array:
    """The covariance with the second order of the move; that of the turn has none.

    The mean stays where the points fit best, so that the mean of the second order counts, too: for
    ``s_i = y^T H_i y`` of Gaussians ``y`` with covariance ``C``, ``E[s_i s_j]`` is
    ``tr(H_i C) tr(H_j C) + 2 tr(H_i C H_j C)``.

    Args:
        covariance: (18,18), or more, of a step.
        centre: (3,) of the points, in camera axes.
    """
    # y = (phi, d): d = -rho + [p]x phi.
    by_step = np.zeros((6, 6))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        by_step[i, i], by_step[3 + i, 3 + i] = 1.0, -1.0
        by_step[3 + j, i], by_step[3 + k, i] = centre[k], -centre[j]
    both = by_step @ np.ascontiguousarray(covariance[:6, :6]) @ by_step.T
    forms = np.zeros((3, 6, 6))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        # (phi x (phi x p))_i = phi_i (phi . p) - p_i (phi . phi)
        for m in range(3):
            forms[i, i, m] -= 0.25 * centre[m]
            forms[i, m, i] -= 0.25 * centre[m]
            forms[i, m, m] += 0.5 * centre[i]
        forms[i, j, 3 + k] = forms[i, 3 + k, j] = -0.5
        forms[i, k, 3 + j] = forms[i, 3 + j, k] = 0.5
    products = np.empty((3, 6, 6))
    for i in range(3):
        products[i] = forms[i] @ both
    farther = covariance.copy()
    for i in range(3):
        for j in range(3):
            second = np.trace(products[i]) * np.trace(products[j])
            second += 2.0 * np.sum(products[i] * products[j].T)
            farther[MOVE, MOVE][i, j] += second
    return farther


@inlined
def told_from(covariance: Array, turn: Array) -> Array:
    """The covariance (n,n) of steps from one state as that of steps from another one.

    With the turn ``a`` from the other state to the one, steps from the other one are

        log(exp([a]x) exp([phi]x)) = a + J(a)^-1 phi + ...   and   ... + exp([a]x) rho,

    where J is the right Jacobian of SO(3).

    Args:
        turn: (3,) first part of the step from the other state to the one.
    """
    x, y, z = turn[0], turn[1], turn[2]
    squared = x * x + y * y + z * z
    angle = np.sqrt(squared)
    second = 1.0 / 12.0
    if angle > 1e-3:
        second = (1.0 - 0.5 * angle * np.sin(angle) / (1.0 - np.cos(angle))) / squared
    # Of the Jacobian only two blocks are not those of the identity.
    blocks = np.zeros((2, 3, 3))
    part = np.array([x, y, z])
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        blocks[0, i, i] = 1.0 - second * squared
        blocks[0, j, k], blocks[0, k, j] = -0.5 * part[i], 0.5 * part[i]
    for i in range(3):
        for j in range(3):
            blocks[0, i, j] += second * part[i] * part[j]
    blocks[1] = exp(turn)
    told = covariance
    for _ in range(2):  # the rows, then those of the transpose
        rows = told.copy()
        for i in range(6):
            block, first = blocks[i // 3, i % 3], i // 3 * 3
            for j in range(len(covariance)):
                rows[i, j] = 0.0
                for k in range(3):
                    rows[i, j] += block[k] * told[first + k, j]
        told = rows.T.copy()
    return told


# Probabilities that have no part in the covariance.
_NO_PART = 1e-5


@kernel
def averaged(
    states: Array, covariances: Array, best: int, counting: Array, possible: Array
) -> tuple[Array, Array, Array]:
    """Mean (24,) of Gaussians by the ones probabilities (k,), covariance (18,18) by the others.

    And the steps (k,18) from the best one to all.
    """
    count = len(states)
    steps, mean = np.empty((count, PARAMETERS)), np.empty(PARAMETERS)
    for k in range(count):
        write(steps[k], step_between(states[best], states[k]))
    for i in range(PARAMETERS):
        total = 0.0
        for k in range(count):
            total += counting[k] * steps[k, i]
        mean[i] = total
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    for k in range(count):
        offset = steps[k] - mean
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                covariance[i, j] += possible[k] * offset[i] * offset[j]
        if possible[k] > _NO_PART:
            covariance += possible[k] * told_from(covariances[k], offset[TURN])
    return apply_step(states[best], mean), covariance, steps


@kernel
def longest_axis(covariance: Array) -> float:
    """Standard deviation (rad) of the turn about the axis that is known worst."""
    return math.sqrt(np.linalg.eigvalsh(covariance[:3, :3].copy())[-1])


def warm_up() -> None:
    """Compile what planes come to that show two poses."""
    longest_axis(np.eye(PARAMETERS))
