"""Pose and twist of the body at one moment of an estimated motion, with their covariances.

The estimate is centred on the middle row and counts time in readouts; what is published holds at
one moment, in SI units, and orders its covariance as REP-103 does. First-order propagation, with
``R = map_from_camera`` and ``c`` the camera centre at ``tau = 0``, and the estimate's errors
``phi, rho, d_omega, d_v`` in its own order:

    rotation(tau) = R exp(phi) exp(tau (omega + d_omega))
                  = exp(R (phi + tau J(tau omega) d_omega)) R exp(tau omega)
    centre(tau)   = c + R rho + tau R exp(phi) (v + d_v)
                  = c + tau R v + R (rho - tau [v]x phi + tau d_v)
    v(tau)        = exp(-tau (omega + d_omega)) (v + d_v)
                  = E v + E d_v + tau [E v]x J(-tau omega) d_omega,   E = exp(-tau omega)

where J is the left Jacobian of SO(3): ``exp(a + d) = exp(J(a) d) exp(a)``; it is the right one of
``-a``.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.so3 import Array
from rs_localizer.core.types import Estimate
from rs_localizer.io.outputs import Pose, Twist

# Blocks of the estimate's covariance and of the published ones.
_PHI, _RHO, _OMEGA, _V = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_LINEAR, _ANGULAR = slice(0, 3), slice(3, 6)


def pose_at(estimate: Estimate, tau: float) -> Pose:
    """Pose of the camera in the map at row time ``tau``."""
    rotation, translation = estimate.at(tau)
    map_from_middle = estimate.rotation.T
    jacobian = np.zeros((6, 12))
    jacobian[_LINEAR, _PHI] = -tau * map_from_middle @ so3.hat(estimate.linear_velocity)
    jacobian[_LINEAR, _RHO] = map_from_middle
    jacobian[_LINEAR, _V] = tau * map_from_middle
    jacobian[_ANGULAR, _PHI] = map_from_middle
    jacobian[_ANGULAR, _OMEGA] = (
        tau * map_from_middle @ so3.right_jacobian(-tau * estimate.angular_velocity)
    )
    return Pose(
        position=-rotation.T @ translation,
        rotation=rotation.T,
        covariance=_propagate(jacobian, estimate.covariance),
    )


def twist_at(estimate: Estimate, tau: float, readout_time: float) -> Twist:
    """Twist of the camera at row time ``tau``, in its axes at that moment; readout_time in s."""
    turn = so3.exp(-tau * estimate.angular_velocity)
    linear = estimate.linear_velocity_at(tau)
    jacobian = np.zeros((6, 12))
    jacobian[_LINEAR, _OMEGA] = (
        tau * so3.hat(linear) @ so3.right_jacobian(tau * estimate.angular_velocity)
    )
    jacobian[_LINEAR, _V] = turn
    jacobian[_ANGULAR, _OMEGA] = np.eye(3)
    return Twist(
        linear=linear / readout_time,
        # The body rate is constant in the body's axes: they turn about it.
        angular=estimate.angular_velocity / readout_time,
        covariance=_propagate(jacobian / readout_time, estimate.covariance),
    )


def _propagate(jacobian: Array, covariance: Array) -> Array:
    result: Array = jacobian @ covariance @ jacobian.T
    return 0.5 * (result + result.T)  # rounding must not cost the symmetry
