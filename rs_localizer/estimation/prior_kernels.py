"""What a prior adds to the normal equations at a state."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.so3 import log
from rs_localizer.core.state import (
    PARAMETERS,
)


@kernel
def add_prior(
    informations: Array,
    references: Array,
    gravity: Array,
    state: Array,
    weight: float,
    information: Array,
    slope: Array,
) -> float:
    """Add the prior's part, times ``weight``, to the normal equations; returns its cost.

    These are of all 18 parameters, or of the first 12, while the accelerations are what they are.
    """
    cost = 0.0
    size = len(slope)
    offset = np.empty(PARAMETERS)
    pulled = np.empty(PARAMETERS)
    # Derivative of the offset by a step: identity but for the rotation and position blocks.
    by_turn, by_move = np.empty((3, 3)), np.empty((3, 3))
    for term in range(len(informations)):
        prior, reference = informations[term], references[term]
        posed = (
            prior[0, 0] + prior[1, 1] + prior[2, 2] + prior[3, 3] + prior[4, 4] + prior[5, 5] > 0
        )
        first = 0 if posed else 6
        for i in range(6):
            offset[i] = 0.0
        for i in range(6, PARAMETERS):
            offset[i] = state[6 + i] - reference[6 + i]
        if posed:
            _pose_offset(state, reference, offset, by_turn, by_move)
        for i in range(first, PARAMETERS):
            total = 0.0
            for j in range(first, PARAMETERS):
                total += prior[i, j] * offset[j]
            pulled[i] = weight * total
            cost += offset[i] * pulled[i]
        if not posed:
            for i in range(6, size):
                slope[i] += pulled[i]
                for j in range(6, size):
                    information[i, j] += weight * prior[i, j]
            continue
        _add_posed(prior, pulled, by_turn, by_move, weight, information, slope)
    if gravity[6] > 0.0:
        cost += _add_gravity(gravity, state, weight, information, slope)
    return cost


@inlined
def _add_posed(
    prior: Array,
    pulled: Array,
    by_turn: Array,
    by_move: Array,
    weight: float,
    information: Array,
    slope: Array,
) -> None:
    """Add J^T P J and J^T p, where J is the identity but for the blocks of turn and move."""
    size = len(slope)
    half = prior.copy()  # P J
    for i in range(size):
        for j in range(3):
            turned, moved = 0.0, 0.0
            for k in range(3):
                turned += prior[i, k] * by_turn[k, j]
                moved += prior[i, 3 + k] * by_move[k, j]
            half[i, j], half[i, 3 + j] = turned, moved
    for i in range(3):
        for j in range(size):
            turned, moved = 0.0, 0.0
            for k in range(3):
                turned += by_turn[k, i] * half[k, j]
                moved += by_move[k, i] * half[3 + k, j]
            information[i, j] += weight * turned
            information[3 + i, j] += weight * moved
        turned, moved = 0.0, 0.0
        for k in range(3):
            turned += by_turn[k, i] * pulled[k]
            moved += by_move[k, i] * pulled[3 + k]
        slope[i] += turned
        slope[3 + i] += moved
    for i in range(6, size):
        slope[i] += pulled[i]
        for j in range(size):
            information[i, j] += weight * half[i, j]


@inlined
def _pose_offset(
    state: Array, reference: Array, offset: Array, by_turn: Array, by_move: Array
) -> None:
    """The step (turn, move) from the reference pose to the state's and its derivatives."""
    relative = np.empty((3, 3))  # reference from state: exp([turn]x)
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += reference[3 * i + k] * state[3 * j + k]
            relative[i, j] = total
            by_move[i, j] = total
    turn = log(relative)
    x, y, z = turn[0], turn[1], turn[2]
    squared = x * x + y * y + z * z
    angle = np.sqrt(squared)
    # Inverse right Jacobian of the exponential; its second coefficient is 1/12 at zero.
    if angle < 1e-3:
        second = 1.0 / 12.0
    else:
        second = (1.0 - 0.5 * angle * np.sin(angle) / (1.0 - np.cos(angle))) / squared
    by_turn[0, 0] = 1.0 - second * (y * y + z * z)
    by_turn[1, 1] = 1.0 - second * (x * x + z * z)
    by_turn[2, 2] = 1.0 - second * (x * x + y * y)
    by_turn[0, 1], by_turn[1, 0] = -0.5 * z + second * x * y, 0.5 * z + second * x * y
    by_turn[0, 2], by_turn[2, 0] = 0.5 * y + second * x * z, -0.5 * y + second * x * z
    by_turn[1, 2], by_turn[2, 1] = -0.5 * x + second * y * z, 0.5 * x + second * y * z
    for i in range(3):
        offset[i] = turn[i]
        moved = 0.0
        for j in range(3):
            moved += relative[i, j] * state[9 + j]
        offset[3 + i] = reference[9 + i] - moved


@inlined
def _add_gravity(
    gravity: Array, state: Array, weight: float, information: Array, slope: Array
) -> float:
    """Part of the measured direction: |R g - m|^2 times its precision."""
    precision = weight * gravity[6]
    seen = np.empty(3)
    for i in range(3):
        total = 0.0
        for j in range(3):
            total += state[3 * i + j] * gravity[j]
        seen[i] = total
    # A turn phi of the camera moves the direction by seen x phi.
    derivative = np.zeros((3, 3))
    derivative[0, 1], derivative[0, 2] = -seen[2], seen[1]
    derivative[1, 0], derivative[1, 2] = seen[2], -seen[0]
    derivative[2, 0], derivative[2, 1] = -seen[1], seen[0]
    cost = 0.0
    for k in range(3):
        error = seen[k] - gravity[3 + k]
        cost += precision * error * error
        for i in range(3):
            slope[i] += precision * derivative[k, i] * error
            for j in range(3):
                information[i, j] += precision * derivative[k, i] * derivative[k, j]
    return cost
