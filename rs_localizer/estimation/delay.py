"""By how much a known turn has to be delayed, by the errors that it leaves.

One that comes too early by ``d`` turns each row by ``d (omega(tau) - omega(0))`` more than it
should; where the camera vibrates, no motion under constant acceleration looks like that. Given the
best motion, with the covariance ``P`` of it, the gradient by ``d`` is ``c^T e`` for the column
``c`` of its derivatives, and what the motion does not take over of it tells its variance (Schur's
complement):

    1 / var = c^T c - c^T J P J^T c,   d = -var c^T e        (in noise variances)
"""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.known_turn import KnownTurn
from rs_localizer.core.lanes.jit import kernel
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.posterior import Posterior
from rs_localizer.estimation.residuals import linearized

# Of the information of the column alone; less is rounding errors.
_LEAST_PART = 1e-6
# Turns (rad) that are not worth the time: a tenth of what a good frame tells of its pose.
_LEAST_TURN = 3e-5


def delay_of(
    observations: Observations, posterior: Posterior, turn: KnownTurn
) -> tuple[float, float]:
    """By how many readouts the known turn has to be delayed, and the variance of that."""
    if turn.roughness * turn.delay < _LEAST_TURN:
        return 0.0, math.inf
    errors, by_motion, by_turn, _ = linearized(
        observations.packed,
        len(observations),
        posterior.state,
        observations.row_time_gradient,
        np.zeros((len(observations), 6)),
    )
    rotations, rates = turn.at_rows(observations.tau)
    covariance = np.ascontiguousarray(posterior.covariance[:PARAMETERS, :PARAMETERS])
    slope, information = _by_delay(
        errors, by_motion, by_turn, posterior.inliers, rotations, rates, turn.rate,
        covariance / posterior.noise**2,
    )  # fmt: skip
    if not information > 0.0:
        return 0.0, math.inf
    return -slope / information, posterior.noise**2 / information


@kernel
def _by_delay(
    errors: Array, by_motion: Array, by_turn: Array, inliers: BoolArray, rotations: Array,
    rates: Array, middle: Array, covariance: Array,
) -> tuple[float, float]:  # fmt: skip
    """Slope and information by the delay, px^2, with the motion free."""
    own, slope = 0.0, 0.0
    shared, late = np.zeros(PARAMETERS), np.empty(3)
    for i in range(len(errors)):
        if not inliers[i]:
            continue
        for k in range(3):  # in the axes of the steadied camera
            late[k] = middle[k]
            for j in range(3):
                late[k] -= rotations[i, j, k] * rates[i, j]
        for row in range(2):
            column = 0.0
            for k in range(3):
                column += by_turn[i, row, k] * late[k]
            own += column * column
            slope += column * errors[i, row]
            for k in range(PARAMETERS):
                shared[k] += column * by_motion[i, row, k]
    taken = 0.0
    for i in range(PARAMETERS):
        for j in range(PARAMETERS):
            taken += shared[i] * covariance[i, j] * shared[j]
    information = own - taken
    return slope, information if information > _LEAST_PART * own else 0.0
