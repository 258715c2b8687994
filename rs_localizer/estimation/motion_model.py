# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Motion from one image to a later one: accelerations that fade while new ones come.

R. Singer, "Estimating optimal tracking filter performance for manned maneuvering targets", 1970.
"""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.config import Acceleration
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, Array2
from rs_localizer.core.blocks import add_block
from rs_localizer.core.gyro_rotation import GyroRotation
from rs_localizer.core.shake import MIDDLE_RATES, MIDDLE_VALUES
from rs_localizer.core.shutter import Motion, Numbers, carried, motion_of, numbers_of
from rs_localizer.core.state import ANGULAR, PARAMETERS
from rs_localizer.core.types import Estimate
from rs_localizer.native import entry, kernel

# Time (s) in which accelerations fade. Of 0.1, 0.05 and 0.03 the last one has the least errors of
# turn rates of a phone in a car and of Aria's head, and the most of them inside.
FADING = 0.03
# Below this part of the time of fading the closed form of the noise is rounding errors.
_SHORT = 0.03


def predict(
    motion: Motion, covariance: Array, readouts: float, fading: float
) -> tuple[Motion, Array]:
    """Predict the motion and its covariance (18,18) some readout times later.

    Accelerations fade by ``exp(-1)`` in ``fading`` readouts. The pose moves on by ``R exp(theta)``
    and ``c + R way``; all parts of the error are carried to first order into the camera axes of
    then.
    """
    later, transport = carried(numbers_of(motion), float(readouts), float(fading))
    return motion_of(later), transport @ covariance @ transport.T


def acceleration_covariance(acceleration: Acceleration, dt: float, readout_time: float) -> Array:
    """Return the covariance (18,18) that new accelerations add over ``dt`` s.

    The deviations are those of the accelerations themselves, at any time (Singer's model in closed
    form).
    """
    deviations = float(acceleration.angular), float(acceleration.linear)
    added: Array = _singer(*deviations, float(dt), float(readout_time))
    return added


@kernel
def singer(seconds: float) -> Array:
    """Return the covariance (3,3) of way, velocity, acceleration per unit acceleration, SI."""
    x = seconds / FADING
    block = np.empty((3, 3))
    if x < _SHORT:
        # White noise on the acceleration, to first order.
        block[0, 0], block[0, 1], block[0, 2] = x**5 / 10.0, x**4 / 4.0, x**3 / 3.0
        block[1, 1], block[1, 2], block[2, 2] = 2.0 * x**3 / 3.0, x**2, 2.0 * x
    else:
        e, e2 = math.exp(-x), math.exp(-2.0 * x)
        block[0, 0] = 1.0 - e2 + 2.0 * x + 2.0 * x**3 / 3.0 - 2.0 * x**2 - 4.0 * x * e
        block[0, 1] = e2 + 1.0 - 2.0 * e + 2.0 * x * e - 2.0 * x + x**2
        block[0, 2] = 1.0 - e2 - 2.0 * x * e
        block[1, 1] = 4.0 * e - 3.0 - e2 + 2.0 * x
        block[1, 2] = e2 + 1.0 - 2.0 * e
        block[2, 2] = 1.0 - e2
    units = (FADING * FADING, FADING, 1.0)
    for i in range(3):
        for j in range(i, 3):
            block[i, j] *= units[i] * units[j]
            block[j, i] = block[i, j]
    return block


@entry
def _singer(angular: float, linear: float, dt: float, readout_time: float) -> Array:
    block, covariance = singer(dt), np.zeros((PARAMETERS, PARAMETERS))
    units = (1.0, readout_time, readout_time * readout_time)
    for i in range(3):
        for j in range(3):
            value = units[i] * units[j] * block[i, j]
            for axis in range(3):
                row, column = 6 * i + axis, 6 * j + axis
                covariance[row, column] = angular * angular * value
                covariance[3 + row, 3 + column] = linear * linear * value
    return covariance


def unshaken(estimate: Estimate) -> tuple[Motion, Array, Array, Array]:
    """Return the motion without vibration, both covariances, and the derivative of that motion.

    A camera that shakes is, in the middle row, somewhere on its swing; a frame later it is
    somewhere else on it. What a gyroscope knows of the turn is not in the motion, either.
    """
    motion, covariance, swing, jacobian = _unshaken(
        numbers_of(estimate.without_gyro()),
        np.ascontiguousarray(estimate.shake),
        np.ascontiguousarray(estimate.joint_covariance),
    )
    return motion_of(motion), covariance, swing, jacobian


@entry
def _unshaken(motion: Numbers, shake: Array2, joint: Array2) -> tuple[Numbers, Array, Array, Array]:
    values, slopes, unit = MIDDLE_VALUES, MIDDLE_RATES, np.eye(3)
    rotation, translation, angular, linear, change, acceleration = motion
    turn, rate, swing = np.zeros(3), np.zeros(3), np.zeros((PARAMETERS, PARAMETERS))
    for k in range(len(shake)):
        square = 0.0
        for axis in range(3):
            turn[axis] += values[k] * shake[k, axis]
            rate[axis] += slopes[k] * shake[k, axis]
            square += shake[k, axis] * shake[k, axis] / 3.0
        add_block(swing, 0, 0, values[k] * values[k] * square, unit)
        add_block(swing, 6, 6, slopes[k] * slopes[k] * square, unit)
    # Derivatives of the motion without its shaking by motion and coefficients.
    jacobian = np.zeros((PARAMETERS, len(joint)))
    for i in range(PARAMETERS):
        jacobian[i, i] = 1.0
    for k in range((len(joint) - PARAMETERS) // 3):
        place = PARAMETERS + 3 * k
        add_block(jacobian, 0, place, -values[k], unit)
        add_block(jacobian, 6, place, -slopes[k], unit)
    # The rotation is undone in its own axes: exp(-[-turn]x) R.
    turned = so3.exp(turn)
    beside = (
        turned @ rotation, turned @ translation, angular - rate, linear.copy(), change.copy(),
        acceleration.copy(),
    )  # fmt: skip
    covariance = jacobian @ joint @ jacobian.T
    # Pose and turn cancel: what rounding leaves of the difference of two large variances.
    for i in range(PARAMETERS):
        for j in range(i):
            covariance[i, j] = 0.5 * (covariance[i, j] + covariance[j, i])
            covariance[j, i] = covariance[i, j]
    return beside, covariance, swing, jacobian


def mean_turn(turn: GyroRotation) -> tuple[Array, Array]:
    """Return the mean rate (3,) of a known turn and a covariance (18,18), to go on without it.

    How much the rate changed within the readout, a gyroscope knows it to change in the next.
    """
    ends, rates = turn.at_rows(np.array([-0.5, 0.5]))
    mean = so3.log(np.ascontiguousarray(ends[0] @ ends[1].T))
    spread = np.zeros((PARAMETERS, PARAMETERS))
    spread[ANGULAR, ANGULAR] = np.mean((rates - mean) ** 2) * np.eye(3)
    return mean, spread
