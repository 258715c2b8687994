"""Pose and twist of the body at one moment of an estimated motion, with their covariances.

The estimate is centred on the middle row and counts time in readouts; what is published holds at
one moment, in SI units, and orders its covariance as REP-103 does. First-order propagation, with
``R = map_from_camera`` and ``c`` the camera centre at ``tau = 0``, the turn ``theta = tau omega +
tau^2/2 alpha`` and the way ``w = tau v + tau^2/2 a`` since then, and the estimate's errors ``phi,
rho, d_omega, d_v, d_alpha, d_a`` in its own order:

    rotation(tau) = R exp(phi) exp(theta + d_theta)
                  = exp(R (phi + J(theta) d_theta)) R exp(theta)
    centre(tau)   = c + R rho + R exp(phi) (w + d_w)
                  = c + R w + R (rho - [w]x phi + d_w)
    v(tau)        = exp(-theta - d_theta) (u + d_u),   u = v + tau a
                  = E u + E d_u + [E u]x J(-theta) d_theta,   E = exp(-theta)
    omega(tau)    = J(-theta) (omega + tau alpha)
                  = omega + tau/2 (I + J(-theta)) alpha + ...

where J is the left Jacobian of SO(3): ``exp(a + d) = exp(J(a) d) exp(a)``; it is the right one of
``-a``. Without acceleration the body rate is ``omega`` at any time; second orders of the
acceleration are left out.
Shaking turns the camera by ``delta(tau)`` in its own axes beside all that; its coefficients stand
behind the motion in the estimate's covariance, and its turn and rate are linear in them. What a
gyroscope knows of the turn comes last: what is said above is of the motion beside it, and then
turned by it; its own noise at one moment is added to the angular velocity's. Where the gyroscope
alone knows the angular velocity of that moment better than motion and turn together, because its
time offset leaves the motion beside the turn to the points, its own is published.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.shake import shake_at, shake_basis, within_rows
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
from rs_localizer.io.outputs import Pose, Twist

# Blocks of the published covariances.
_LINEAR, _ANGULAR = slice(0, 3), slice(3, 6)
# Where the shaking is asked how fast it is.
_ROWS = np.linspace(-0.5, 0.5, 17)


def pose_at(estimate: Estimate, tau: float) -> Pose:
    """Pose of the camera in the map at row time ``tau``."""
    rotation, translation = estimate.at(tau)
    map_from_middle, map_from_then = estimate.rotation.T, rotation.T
    motion = estimate.beside_turn()
    by_angle = map_from_middle @ so3.right_jacobian(-motion.angle_at(tau))
    values, _ = _shaking(estimate, tau)
    jacobian = np.zeros((6, len(estimate.joint_covariance)))
    jacobian[_LINEAR, TURN] = -map_from_middle @ so3.hat(motion.way_at(tau))
    jacobian[_LINEAR, MOVE] = map_from_middle
    jacobian[_LINEAR, LINEAR] = tau * map_from_middle
    jacobian[_LINEAR, LINEAR_ACCELERATION] = 0.5 * tau * tau * map_from_middle
    jacobian[_ANGULAR, TURN] = map_from_middle
    jacobian[_ANGULAR, ANGULAR] = tau * by_angle
    jacobian[_ANGULAR, ANGULAR_ACCELERATION] = 0.5 * tau * tau * by_angle
    if estimate.turn is not None:
        map_from_then = map_from_then @ estimate.turn.at(tau)[0]
    jacobian[_ANGULAR, PARAMETERS:] = _by_polynomials(values, map_from_then)
    covariance = _propagate(jacobian, estimate.joint_covariance)
    if estimate.turn is not None:
        late = estimate.turn.delay * rotation.T @ estimate.turn.late(tau)[0]
        covariance[_ANGULAR, _ANGULAR] += np.outer(late, late)
    covariance[_ANGULAR, _ANGULAR] += _beyond_rows(estimate, tau)[0] * np.eye(3)
    return Pose(position=-rotation.T @ translation, rotation=rotation.T, covariance=covariance)


def twist_at(estimate: Estimate, tau: float, readout_time: float) -> Twist:
    """Twist of the camera at row time ``tau``, in its axes at that moment; readout_time in s."""
    linear = estimate.linear_velocity_at(tau)
    shaken = estimate.turned_beside(tau)
    motion = estimate.beside_turn()
    angle = motion.angle_at(tau)
    turn = shaken @ so3.exp(-angle)
    by_angle = so3.hat(linear) @ shaken @ so3.right_jacobian(angle)
    angular = estimate.angular_velocity_at(tau)
    by_acceleration = 0.5 * tau * shaken @ (np.eye(3) + so3.right_jacobian(angle))
    values, rates = _shaking(estimate, tau)
    jacobian = np.zeros((6, len(estimate.joint_covariance)))
    jacobian[_LINEAR, ANGULAR] = tau * by_angle
    jacobian[_LINEAR, ANGULAR_ACCELERATION] = 0.5 * tau * tau * by_angle
    jacobian[_LINEAR, LINEAR] = turn
    jacobian[_LINEAR, LINEAR_ACCELERATION] = tau * turn
    jacobian[_ANGULAR, ANGULAR] = shaken
    jacobian[_ANGULAR, ANGULAR_ACCELERATION] = by_acceleration
    known, rate, own = np.eye(3), np.zeros(3), np.zeros((3, 3))
    if estimate.turn is not None:
        known, rate = estimate.turn.at(tau)
        late = estimate.turn.delay * estimate.turn.late(tau)[1]
        own = np.outer(late, late) + estimate.turn.rate_noise**2 * np.eye(3)
    jacobian[_LINEAR, PARAMETERS:] = _by_polynomials(values, so3.hat(linear) @ known)
    by_shake = _by_polynomials(values, so3.hat(angular - rate) @ known)
    jacobian[_ANGULAR, PARAMETERS:] = _by_polynomials(rates, known) + by_shake
    covariance = _propagate(jacobian / readout_time, estimate.joint_covariance)
    turned, changed = _beyond_rows(estimate, tau)
    own = own + changed * np.eye(3)
    covariance[_ANGULAR, _ANGULAR] += own / readout_time**2
    covariance[_LINEAR, _LINEAR] += turned / readout_time**2 * so3.hat(linear) @ so3.hat(linear).T
    measured = None if estimate.turn is None else estimate.turn.rate_at(tau)
    if measured is not None:
        error = measured[1] / readout_time**2
        if np.trace(error) < np.trace(covariance[_ANGULAR, _ANGULAR]):
            angular = measured[0]
            covariance[_ANGULAR] = 0.0
            covariance[:, _ANGULAR] = 0.0
            covariance[_ANGULAR, _ANGULAR] = error
    return Twist(
        linear=linear / readout_time, angular=angular / readout_time, covariance=covariance
    )


def with_timing(pose: Pose, twist: Twist, deviation: float, delay: float) -> tuple[Pose, Twist]:
    """The covariances with what is not known of the readout time.

    Args:
        pose, twist: of the camera at one moment.
        deviation: of the readout time, as a part of it: velocities are inverse to it.
        delay: s by which the moment itself is uncertain.
    """
    velocity = np.concatenate([twist.linear, twist.angular])
    in_map = np.concatenate([pose.rotation @ twist.linear, pose.rotation @ twist.angular])
    return (
        replace(pose, covariance=pose.covariance + delay**2 * np.outer(in_map, in_map)),
        replace(twist, covariance=twist.covariance + deviation**2 * np.outer(velocity, velocity)),
    )


def _shaking(estimate: Estimate, tau: float) -> tuple[Array, Array]:
    """The polynomials (k,) of the shaking at ``tau``, and their rates (k,)."""
    count = (len(estimate.joint_covariance) - PARAMETERS) // 3
    values, rates = np.empty(count), np.empty(count)
    if count:
        shake_basis(within_rows(tau), count + 1, values, rates)
    if tau != within_rows(tau):  # it stays as it was
        rates[:] = 0.0
    return values, rates


def _by_polynomials(values: Array, matrix: Array) -> Array:
    """``matrix`` (3,3) times each of the values (k,), side by side (3,3 k)."""
    side_by_side: Array = (matrix[:, None, :] * values[:, None]).reshape(3, -1)
    return side_by_side


def _beyond_rows(estimate: Estimate, tau: float) -> tuple[float, float]:
    """Variances of the turn (rad^2) and of its rate, per readout, that no row has seen.

    A camera that shakes within the rows shakes outside, too, in a phase that nobody knows: it is
    taken to go on at one of the rates that it had. What gyroscopes have seen, is known.
    """
    beyond = abs(tau - within_rows(tau))
    if beyond == 0.0:
        return 0.0, 0.0
    rates = shake_at(_ROWS, estimate.shake)[:, 3:]
    variance = float(np.mean(rates**2))
    turn, rate = variance * beyond**2, variance
    if estimate.turn is not None:
        first, last = float(estimate.turn.tau[0]), float(estimate.turn.tau[-1])
        unknown = abs(tau - min(max(tau, first), last))
        if unknown > 0.0:
            known = estimate.turn.at_rows(_ROWS)[1]
            # Of a rate that goes on as it changes, the distance from the mean at this row.
            variance = float(np.mean((known - known.mean(axis=0)) ** 2))
            variance *= 3.0 * (1.0 + 2.0 * beyond) ** 2
            turn, rate = turn + variance * unknown**2, rate + variance
    return turn, rate


def _propagate(jacobian: Array, covariance: Array) -> Array:
    result: Array = jacobian @ covariance @ jacobian.T
    return 0.5 * (result + result.T)  # rounding must not cost the symmetry
