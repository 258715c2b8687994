# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pose and twist at a moment in plain NumPy: what the kernels are compared with."""

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.gyro_rotation import late_at
from rs_localizer.core.rate_spline import change_at
from rs_localizer.core.shake import within_rows
from rs_localizer.core.state import (
    ANGULAR,
    ANGULAR_ACCELERATION,
    LINEAR,
    LINEAR_ACCELERATION,
    MOVE,
    PARAMETERS,
    TURN,
)
from rs_localizer.core.types import Estimate

PLACE, DIRECTION = slice(0, 3), slice(3, 6)


def plain_pose(estimate: Estimate, tau: float) -> tuple[Array, Array, Array]:
    """Position, rotation map_from_camera and covariance at a row time within the rows."""
    rotation, translation = estimate.at(tau)
    map_from_middle, map_from_then = estimate.rotation.T, rotation.T
    motion = estimate.without_gyro()
    by_angle = map_from_middle @ so3.right_jacobian(-motion.angle_at(tau))
    values, _ = shaking(estimate, tau)
    jacobian = np.zeros((6, len(estimate.joint_covariance)))
    jacobian[PLACE, TURN] = -map_from_middle @ so3.hat(motion.way_at(tau))
    jacobian[PLACE, MOVE] = map_from_middle
    jacobian[PLACE, LINEAR] = tau * map_from_middle
    jacobian[PLACE, LINEAR_ACCELERATION] = 0.5 * tau * tau * map_from_middle
    jacobian[DIRECTION, TURN] = map_from_middle
    jacobian[DIRECTION, ANGULAR] = tau * by_angle
    jacobian[DIRECTION, ANGULAR_ACCELERATION] = 0.5 * tau * tau * by_angle
    late = np.zeros(3)
    if estimate.turn is not None:
        map_from_then = map_from_then @ estimate.turn.at(tau)[0]
        late = estimate.turn.delay * rotation.T @ late_of(estimate, tau)[0]
    jacobian[DIRECTION, PARAMETERS:] = np.kron(values, map_from_then)
    covariance = jacobian @ estimate.joint_covariance @ jacobian.T
    covariance[DIRECTION, DIRECTION] += np.outer(late, late)
    return -rotation.T @ translation, rotation.T, covariance


def plain_twist(estimate: Estimate, tau: float) -> tuple[Array, Array, Array]:
    """Linear and angular velocity per readout, and their covariance, within the rows."""
    linear = estimate.linear_velocity_at(tau)
    shaken = estimate.turned_beside(tau)
    angle = estimate.without_gyro().angle_at(tau)
    angular = estimate.angular_velocity_at(tau)
    by_angle = so3.hat(linear) @ shaken @ so3.right_jacobian(angle)
    values, rates = shaking(estimate, tau)
    known, rate = np.eye(3), np.zeros(3)
    if estimate.turn is not None:
        known, rate = estimate.turn.at(tau)
    jacobian = np.zeros((6, len(estimate.joint_covariance)))
    jacobian[PLACE, ANGULAR] = tau * by_angle
    jacobian[PLACE, ANGULAR_ACCELERATION] = 0.5 * tau * tau * by_angle
    jacobian[PLACE, LINEAR] = shaken @ so3.exp(-angle)
    jacobian[PLACE, LINEAR_ACCELERATION] = tau * shaken @ so3.exp(-angle)
    jacobian[DIRECTION, ANGULAR] = shaken
    jacobian[DIRECTION, ANGULAR_ACCELERATION] = (
        0.5 * tau * shaken @ (np.eye(3) + so3.right_jacobian(angle))
    )
    jacobian[PLACE, PARAMETERS:] = np.kron(values, so3.hat(linear) @ known)
    jacobian[DIRECTION, PARAMETERS:] = np.kron(rates, known)
    jacobian[DIRECTION, PARAMETERS:] += np.kron(values, so3.hat(angular - rate) @ known)
    covariance = jacobian @ estimate.joint_covariance @ jacobian.T
    turn = estimate.turn
    if turn is None:
        return linear, angular, covariance
    late = turn.delay * late_of(estimate, tau)[1]
    covariance[DIRECTION, DIRECTION] += np.outer(late, late) + turn.rate_noise**2 * np.eye(3)
    if turn.rate_error is not None and turn.tau[0] <= tau <= turn.tau[-1]:
        late = turn.delay * change_at(tau, turn.tau, turn.rates)
        error = turn.rate_error + turn.rate_noise**2 * np.eye(3) + np.outer(late, late)
        if np.trace(error) < np.trace(covariance[DIRECTION, DIRECTION]):
            angular = rate
            covariance[DIRECTION], covariance[:, DIRECTION] = 0.0, 0.0
            covariance[DIRECTION, DIRECTION] = error
    return linear, angular, covariance


def late_of(estimate: Estimate, tau: float) -> tuple[Array, Array]:
    turn = estimate.turn
    assert turn is not None
    turned, rate = late_at(tau, turn.tau, turn.rates, turn.parabola)
    return turned, rate


def shaking(estimate: Estimate, tau: float) -> tuple[Array, Array]:
    """Cosines and sines (k,) at a row time, less value and slope in the middle, and their rates.

    As many as the covariance is of: two per half-cycle of the readout.
    """
    count = (len(estimate.joint_covariance) - PARAMETERS) // 3
    rate = np.pi * np.arange(1, count // 2 + 1)
    angle = rate * within_rows(tau)
    values = np.column_stack([np.cos(angle) - 1.0, np.sin(angle) - angle])
    rates = rate[:, None] * np.column_stack([-np.sin(angle), np.cos(angle) - 1.0])
    return values.ravel(), rates.ravel()
