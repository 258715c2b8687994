# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The extended Kalman filter of robot_localization, to see what it makes of our outputs.

T. Moore, D. Stouch, "A Generalized Extended Kalman Filter Implementation for the Robot Operating
System", IAS-13, 2014: 15 states, a body that moves with constant acceleration and turns with
constant rate, measurements of states. As ekf_node has them: roll, pitch and yaw about fixed axes
(REP-103), velocities and accelerations in the body, process noise per second, covariances of
messages taken as they are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.io.outputs import Pose, Twist

POSITION, ANGLES, LINEAR, ANGULAR, ACCELERATION = (slice(i, i + 3) for i in range(0, 15, 3))
_STATES = 15
_STEP = 1e-6


class Ekf:
    """The filter of one body.

    Args:
        process_noise: (15,) variances per second.
        pose: the first one, and where the filter begins.
        velocities: (2,) standard deviations of the first linear (m/s) and angular (rad/s) velocity,
            which are taken for zero, as is the acceleration.
        acceleration: standard deviation of the first acceleration (m/s^2).
    """

    def __init__(
        self, process_noise: Array, pose: Pose, velocities: tuple[float, float], acceleration: float
    ) -> None:
        self.state = np.zeros(_STATES)
        self.state[:6] = pose_state(pose)
        self.covariance = np.zeros((_STATES, _STATES))
        self.covariance[:6, :6] = pose.covariance
        deviations = np.repeat([*velocities, acceleration], 3)
        self.covariance[6:, 6:] = np.diag(deviations**2)
        self._process_noise = np.diag(process_noise)

    def predict(self, seconds: float) -> None:
        """Go on by a time (s)."""
        steps = _STEP * np.eye(_STATES)
        ahead = np.array([_moved(self.state + step, seconds) for step in steps])
        back = np.array([_moved(self.state - step, seconds) for step in steps])
        jacobian = (ahead - back).T / (2.0 * _STEP)
        self.state = _moved(self.state, seconds)
        self.covariance = jacobian @ self.covariance @ jacobian.T + seconds * self._process_noise

    def correct_pose(self, pose: Pose) -> None:
        """Take a pose of the body."""
        self._correct(np.arange(6), pose_state(pose), pose.covariance)

    def correct_twist(self, twist: Twist, linear: bool) -> None:
        """Take the turn rate of the body, and its velocity, too, if wanted."""
        measured = np.concatenate([twist.linear, twist.angular])
        used = np.arange(0 if linear else 3, 6)
        self._correct(6 + used, measured[used], twist.covariance[np.ix_(used, used)])

    def _correct(self, states: NDArray[np.int_], measured: Array, covariance: Array) -> None:
        gain_of = self.covariance[:, states]
        innovation = measured - self.state[states]
        innovation[(states >= 3) & (states < 6)] = _wrapped(
            innovation[(states >= 3) & (states < 6)]
        )
        gain = np.linalg.solve(self.covariance[np.ix_(states, states)] + covariance, gain_of.T).T
        self.state = self.state + gain @ innovation
        self.state[ANGLES] = _wrapped(self.state[ANGLES])
        left = np.eye(_STATES)
        left[:, states] -= gain
        self.covariance = left @ self.covariance @ left.T + gain @ covariance @ gain.T

    def error(self, position: Array, rotation: Array, linear: Array, angular: Array) -> Array:
        """(12,) of position, angles and velocities against the truth."""
        truth = np.concatenate([position, angles(rotation), linear, angular])
        found: Array = self.state[:12] - truth
        found[ANGLES] = _wrapped(found[ANGLES])
        return found


def angles(rotation: Array) -> Array:
    """Roll, pitch, yaw about the fixed axes."""
    found: Array = Rotation.from_matrix(rotation).as_euler("xyz")
    return found


def pose_state(pose: Pose) -> Array:
    """Its position and angles."""
    return np.concatenate([pose.position, angles(pose.rotation)])


def nees(error: Array, covariance: Array) -> float:
    """The squared error in standard deviations (normalized estimation error squared)."""
    return float(error @ np.linalg.solve(covariance, error))


def _moved(state: Array, seconds: float) -> Array:
    roll, pitch, _ = state[ANGLES]
    rotation = Rotation.from_euler("xyz", state[ANGLES]).as_matrix()
    sine, cosine, tangent = np.sin(roll), np.cos(roll), np.tan(pitch)
    of_angles = np.array(
        [
            [1.0, sine * tangent, cosine * tangent],
            [0.0, cosine, -sine],
            [0.0, sine / np.cos(pitch), cosine / np.cos(pitch)],
        ]
    )
    way = state[LINEAR] * seconds + 0.5 * state[ACCELERATION] * seconds**2
    moved: Array = state.copy()
    moved[POSITION] += rotation @ way
    moved[ANGLES] += of_angles @ state[ANGULAR] * seconds
    moved[LINEAR] += state[ACCELERATION] * seconds
    return moved


def _wrapped(angle: Array) -> Array:
    wrapped: Array = (angle + np.pi) % (2.0 * np.pi) - np.pi
    return wrapped
