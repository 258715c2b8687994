# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Covariances of pose and twist at one row time in REP-103's order: kernels of ``pose_at_time``."""

from __future__ import annotations

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, Array2
from rs_localizer.core.blocks import add_block
from rs_localizer.core.shake import FUNCTIONS, shake_basis
from rs_localizer.core.shutter import Numbers
from rs_localizer.core.state import PARAMETERS
from rs_localizer.native import entry, kernel


@entry
def pose_of(
    motion: Numbers, shake: Array2, joint: Array2, tau: float, beyond: float
) -> tuple[Array, Array, Array]:
    """Return position (3,), rotation (3,3) map_from_camera, and covariance (6,6), position first.

    Args:
        motion: at the middle row.
        shake: (k,3) coefficients.
        joint: (18 + 3 k,18 + 3 k) covariance of motion and coefficients.
        tau: row time.
        beyond: variance of the turn (rad^2) that no row has seen.
    """
    rotation, translation, angular, linear, change, acceleration = motion
    angle = tau * angular + 0.5 * tau * tau * change
    displacement = tau * linear + 0.5 * tau * tau * acceleration
    map_from_middle = np.ascontiguousarray(rotation.T)
    values, _, turned, _ = _shaken(shake, tau, max(_columns(joint), len(shake)))
    map_from_then = map_from_middle @ so3.exp(angle) @ so3.exp(turned)
    by_angle = map_from_middle @ so3.right_jacobian_of(-angle)
    jacobian = np.zeros((6, len(joint)))
    add_block(jacobian, 0, 0, -1.0, map_from_middle @ so3.hat_of(displacement))
    add_block(jacobian, 0, 3, 1.0, map_from_middle)
    add_block(jacobian, 0, 9, tau, map_from_middle)
    add_block(jacobian, 0, 15, 0.5 * tau * tau, map_from_middle)
    add_block(jacobian, 3, 0, 1.0, map_from_middle)
    add_block(jacobian, 3, 6, tau, by_angle)
    add_block(jacobian, 3, 12, 0.5 * tau * tau, by_angle)
    for k in range(_columns(joint)):
        add_block(jacobian, 3, PARAMETERS + 3 * k, values[k], map_from_then)
    covariance = _propagated(jacobian, joint)
    for i in range(3):
        covariance[3 + i, 3 + i] += beyond
    return map_from_middle @ (displacement - translation), map_from_then, covariance


@entry
def twist_of(
    motion: Numbers, shake: Array2, joint: Array2, tau: float, beyond: tuple[float, float]
) -> tuple[Array, Array, Array]:
    """Return linear and angular velocity (3,) per readout, camera axes, and covariance (6,6).

    Args:
        motion, shake, joint, tau: as of :func:`pose_of`.
        beyond: variances of the turn (rad^2) and its rate that no row has seen.
    """
    _, _, rate, linear_velocity, change, acceleration = motion
    angle = tau * rate + 0.5 * tau * tau * change
    values, rates, turned, swing = _shaken(shake, tau, max(_columns(joint), len(shake)))
    beside, unit = so3.exp(-turned), np.eye(3)
    back, by_angle = so3.exp(-angle), so3.right_jacobian_of(angle)
    linear = beside @ (back @ (linear_velocity + tau * acceleration))
    body_rate = beside @ (by_angle @ (rate + tau * change))
    angular = body_rate + so3.right_jacobian_of(turned) @ swing
    by_turn = beside @ back
    by_rate = so3.hat_of(linear) @ (beside @ by_angle)
    by_acceleration = 0.5 * tau * (beside @ (np.eye(3) + by_angle))
    jacobian = np.zeros((6, len(joint)))
    add_block(jacobian, 0, 6, tau, by_rate)
    add_block(jacobian, 0, 12, 0.5 * tau * tau, by_rate)
    add_block(jacobian, 0, 9, 1.0, by_turn)
    add_block(jacobian, 0, 15, tau, by_turn)
    add_block(jacobian, 3, 6, 1.0, beside)
    add_block(jacobian, 3, 12, 1.0, by_acceleration)
    across, angular_by_shake = so3.hat_of(linear), so3.hat_of(angular)
    for k in range(_columns(joint)):
        place = PARAMETERS + 3 * k
        add_block(jacobian, 0, place, values[k], across)
        add_block(jacobian, 3, place, rates[k], unit)
        add_block(jacobian, 3, place, values[k], angular_by_shake)
    covariance = _propagated(jacobian, joint)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                covariance[i, j] += beyond[0] * across[i, k] * across[j, k]
        covariance[3 + i, 3 + i] += beyond[1]
    return linear, angular, covariance


@kernel
def _shaken(shake: Array, tau: float, count: int) -> tuple[Array, Array, Array, Array]:
    """Return the functions of vibration at a row time, their rates, the rotation (3,), its rate.

    Before the first and after the last row the camera stays as it was.
    """
    here = min(max(tau, -0.5), 0.5)
    values, rates = np.zeros(FUNCTIONS), np.zeros(FUNCTIONS)
    if count:
        shake_basis(here, values, rates)
    if tau != here:
        rates[:] = 0.0
    turn, rate = np.zeros(3), np.zeros(3)
    for k in range(len(shake)):
        for axis in range(3):
            turn[axis] += values[k] * shake[k, axis]
            rate[axis] += rates[k] * shake[k, axis]
    return values, rates, turn, rate


@kernel
def _columns(joint: Array) -> int:
    """Return the number of polynomials in a joint covariance."""
    return (len(joint) - PARAMETERS) // 3


@kernel
def _propagated(jacobian: Array, covariance: Array) -> Array:
    """Return the propagated covariance, symmetric to the bit."""
    propagated = jacobian @ covariance @ jacobian.T
    for i in range(len(propagated)):
        for j in range(i):
            propagated[i, j] = 0.5 * (propagated[i, j] + propagated[j, i])
            propagated[j, i] = propagated[i, j]
    return propagated
