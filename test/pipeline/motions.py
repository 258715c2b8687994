# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Motions with errors, and what these make of functions of the motion."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.core.types import Estimate


def disturbed(motion: Estimate, error: Array) -> Estimate:
    """The motion with errors in the order of its joint covariance, by its definition."""
    phi, rho, d_omega, d_v, d_alpha, d_a = error[:18].reshape(6, 3)
    map_from_camera = motion.rotation.T
    centre = -map_from_camera @ motion.translation + map_from_camera @ rho
    rotation = Rotation.from_rotvec(-phi).as_matrix() @ motion.rotation
    return replace(
        motion,
        rotation=rotation,
        translation=-rotation @ centre,
        angular_velocity=motion.angular_velocity + d_omega,
        linear_velocity=motion.linear_velocity + d_v,
        angular_acceleration=motion.angular_acceleration + d_alpha,
        linear_acceleration=motion.linear_acceleration + d_a,
        shake=motion.shake + error[18:].reshape(-1, 3),
    )


def covariance_of(function: Callable[[Array], Array], of: Array, step: float) -> Array:
    """Of a function of errors with this covariance, by central differences."""
    units = step * np.eye(len(of))
    columns = [(function(unit) - function(-unit)) / (2.0 * step) for unit in units]
    jacobian = np.array(columns).T
    result: Array = jacobian @ of @ jacobian.T
    return result
