# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Places of a motion's numbers: in its state, and in a step or a covariance.

A state holds rotation (9, row-major) and translation (3), camera_from_map at the middle row. Then
follow the angular and linear velocities (3, 3) and the accelerations (3, 3) there, per readout and
per readout squared (:class:`rs_localizer.core.shutter.Motion`). A step has three parameters for the
rotation; :func:`rs_localizer.estimation.robust.apply_step` applies it.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, Array1, Out
from rs_localizer.native import entry

STATE_SIZE = 24
PARAMETERS = 18
# Pose and velocities: what a search knows, and what ``Estimate.covariance`` is of.
MOTION_PARAMETERS = 12

# Parts of a step: the camera rotates, moves in its own axes, and changes velocities and
# accelerations.
TURN, MOVE, ANGULAR, LINEAR, ANGULAR_ACCELERATION, LINEAR_ACCELERATION = (
    slice(k, k + 3) for k in range(0, PARAMETERS, 3)
)
POSE, VELOCITIES, ACCELERATIONS = slice(0, 6), slice(6, 12), slice(12, 18)

# Parts of a state, after the rotation.
(
    STATE_TRANSLATION,
    STATE_ANGULAR,
    STATE_LINEAR,
    STATE_ANGULAR_ACCELERATION,
    STATE_LINEAR_ACCELERATION,
) = (slice(k, k + 3) for k in range(9, STATE_SIZE, 3))
POSE_SIZE = STATE_TRANSLATION.stop


def rotation_of(state: Array) -> Array:
    """Return the rotation (3,3) camera_from_map at the middle row."""
    return state[:9].reshape(3, 3)


@entry
def step_between(state: Out[Array1], other: Array1) -> Array:
    """Return the step (18,) that leads from one state to another."""
    turn, step = np.empty((3, 3)), np.empty(PARAMETERS)
    for i in range(3):
        moved = state[POSE_SIZE - 3 + i]
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += state[3 * i + k] * other[3 * j + k]
            turn[i, j] = total
            moved -= total * other[POSE_SIZE - 3 + j]
        step[3 + i] = moved
    turned = so3.log(turn)
    for i in range(3):
        step[i] = turned[i]
    for i in range(6, PARAMETERS):
        step[i] = other[6 + i] - state[6 + i]
    return step
