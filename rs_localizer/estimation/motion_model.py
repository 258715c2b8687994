"""From one image to a later one: accelerations that fade while new ones come.

R. Singer, "Estimating optimal tracking filter performance for manned maneuvering targets", 1970.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from rs_localizer.config import Acceleration
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.known_turn import KnownTurn
from rs_localizer.core.shake import shake_in_the_middle
from rs_localizer.core.shutter import Motion
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

# Time (s) in which accelerations fade: hands and drones change them about twice a second.
FADING = 0.1
# Below this part of the time of fading the closed form of the noise is rounding errors.
_SHORT = 0.03
_IDENTITY = np.eye(3)


def predict(
    motion: Motion, covariance: Array, readouts: float, fading: float
) -> tuple[Motion, Array]:
    """The motion and its covariance (18,18) some readout times later.

    Accelerations fade by ``exp(-1)`` in ``fading`` readouts. The pose moves on by ``R exp(theta)``
    and ``c + R way``; all parts of the error are carried to first order into the camera axes of
    then.
    """
    left = math.exp(-readouts / fading)
    # What a unit of acceleration adds to the velocity and to the way.
    faster = fading * (1.0 - left)
    farther = fading * (readouts - faster)
    angle = readouts * motion.angular_velocity + farther * motion.angular_acceleration
    way = readouts * motion.linear_velocity + farther * motion.linear_acceleration
    back = so3.exp(-angle)  # then_from_now
    turned = so3.right_jacobian(angle)
    velocity = back @ (motion.linear_velocity + faster * motion.linear_acceleration)
    later = Motion(
        back @ motion.rotation,
        back @ (motion.translation - way),
        turned @ (motion.angular_velocity + faster * motion.angular_acceleration),
        velocity,
        angular_acceleration=left * motion.angular_acceleration,
        linear_acceleration=left * back @ motion.linear_acceleration,
    )
    transport = np.eye(PARAMETERS)
    transport[TURN, TURN] = back
    transport[TURN, ANGULAR] = readouts * turned
    transport[TURN, ANGULAR_ACCELERATION] = farther * turned
    transport[MOVE, MOVE] = back
    transport[MOVE, TURN] = -back @ so3.hat(way)
    transport[MOVE, LINEAR] = readouts * back
    transport[MOVE, LINEAR_ACCELERATION] = farther * back
    # Without acceleration the body rate stays what it is, however far the camera turns.
    mean = farther / readouts
    transport[ANGULAR, ANGULAR_ACCELERATION] = mean * np.eye(3) + (faster - mean) * turned
    transport[LINEAR, LINEAR] = back
    transport[LINEAR, LINEAR_ACCELERATION] = faster * back
    transport[LINEAR, ANGULAR] = readouts * so3.hat(velocity) @ turned
    transport[LINEAR, ANGULAR_ACCELERATION] = farther * so3.hat(velocity) @ turned
    transport[ANGULAR_ACCELERATION, ANGULAR_ACCELERATION] = left * np.eye(3)
    transport[LINEAR_ACCELERATION, LINEAR_ACCELERATION] = left * back
    return later, transport @ covariance @ transport.T


def acceleration_covariance(acceleration: Acceleration, dt: float, readout_time: float) -> Array:
    """Covariance (18,18) that new accelerations add to a prediction over ``dt`` s.

    The deviations are those of the accelerations themselves, at any time (Singer's model in closed
    form).
    """
    x = dt / FADING
    if x < _SHORT:
        # White noise on the acceleration, to first order.
        upper = [[x**5 / 10.0, x**4 / 4.0, x**3 / 3.0], [0.0, 2.0 * x**3 / 3.0, x**2]]
        last = 2.0 * x
    else:
        e, e2 = math.exp(-x), math.exp(-2.0 * x)
        upper = [
            [
                1.0 - e2 + 2.0 * x + 2.0 * x**3 / 3.0 - 2.0 * x**2 - 4.0 * x * e,
                e2 + 1.0 - 2.0 * e + 2.0 * x * e - 2.0 * x + x**2,
                1.0 - e2 - 2.0 * x * e,
            ],
            [0.0, 4.0 * e - 3.0 - e2 + 2.0 * x, e2 + 1.0 - 2.0 * e],
        ]
        last = 1.0 - e2
    block = np.array([*upper, [0.0, 0.0, last]])
    block = np.triu(block) + np.triu(block, 1).T
    # Way, velocity per readout and acceleration per readout squared of a unit acceleration.
    units = np.array([FADING**2, FADING * readout_time, readout_time**2])
    block *= np.outer(units, units)
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    angular, linear = (TURN, ANGULAR, ANGULAR_ACCELERATION), (MOVE, LINEAR, LINEAR_ACCELERATION)
    for deviation, parts in ((acceleration.angular, angular), (acceleration.linear, linear)):
        for i, rows in enumerate(parts):
            for j, columns in enumerate(parts):
                covariance[rows, columns] = deviation**2 * block[i, j] * _IDENTITY
    return covariance


@cache
def _without_shaking(coefficients: int) -> Array:
    """Derivatives (18,18 + 3 k) of a motion without its shaking by motion and coefficients."""
    jacobian = np.eye(PARAMETERS, PARAMETERS + 3 * coefficients)
    if coefficients:
        values, slopes = shake_in_the_middle(coefficients)
        jacobian[TURN, PARAMETERS:] = -np.kron(values[None], np.eye(3))
        jacobian[ANGULAR, PARAMETERS:] = -np.kron(slopes[None], np.eye(3))
    return jacobian


def unshaken(estimate: Estimate) -> tuple[Motion, Array, Array]:
    """The motion without its shaking, its covariance (18,18), and that of the shaking.

    A camera that shakes is, in the middle row, somewhere on its swing; a frame later it is
    somewhere else on it. What a gyroscope knows of the turn is not in the motion, either.
    """
    values, slopes = shake_in_the_middle(len(estimate.shake))
    turn, rate = values @ estimate.shake, slopes @ estimate.shake
    # As if turned back in its own axes: exp(-[-turn]x) R.
    turned = so3.exp(turn)
    beside = estimate.beside_turn()
    motion = Motion(
        turned @ beside.rotation,
        turned @ beside.translation,
        beside.angular_velocity - rate,
        beside.linear_velocity,
        angular_acceleration=beside.angular_acceleration,
        linear_acceleration=beside.linear_acceleration,
    )
    jacobian = _without_shaking((len(estimate.joint_covariance) - PARAMETERS) // 3)
    swing = np.zeros((PARAMETERS, PARAMETERS))
    squares = np.mean(estimate.shake**2, axis=1)
    if len(squares):
        values, slopes = shake_in_the_middle(len(squares))
        swing[TURN, TURN] = (values**2 @ squares) * np.eye(3)
        swing[ANGULAR, ANGULAR] = (slopes**2 @ squares) * np.eye(3)
    return motion, jacobian @ estimate.joint_covariance @ jacobian.T, swing


def with_mean_turn(motion: Motion, covariance: Array, turn: KnownTurn) -> tuple[Motion, Array]:
    """A motion beside a known turn with the mean rate of that, for a camera that goes on alone.

    How much the rate changed within the readout, a gyroscope knows it to change in the next.
    """
    ends, rates = turn.at_rows(np.array([-0.5, 0.5]))
    mean = so3.log(np.ascontiguousarray(ends[0] @ ends[1].T))
    spread = np.zeros((PARAMETERS, PARAMETERS))
    spread[ANGULAR, ANGULAR] = np.mean((rates - mean) ** 2) * np.eye(3)
    faster = replace(motion, angular_velocity=motion.angular_velocity + mean)
    return faster, covariance + spread
