# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The rolling-shutter motion model: row time -> pose -> camera point -> pixel.

Row time ``tau`` is -0.5 at the first exposed row (or column) of the full sensor image and 0.5 at
the last. Over the readout the camera turns and its centre moves, both under constant acceleration
(model B of the project):

    camera_point(tau) = exp(-[tau omega + tau^2/2 alpha]x) (R X + t - tau v - tau^2/2 a)

``R, t`` is the pose camera_from_map at ``tau = 0``. ``omega`` is the camera's body rate in rad per
readout, ``v`` the velocity of its centre in metres per readout, both in the camera axes at ``tau =
0``; ``alpha`` and ``a`` are their changes. The minimal solvers have no accelerations.
 In the literature's letters (Kukelova et al., ACCV 2018): ``w = -omega``; model A
there has ``exp(tau [w]x) R X + t + tau t_drift``, so ``t_drift = w x t - v``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, Array1, Array2
from rs_localizer.core.blocks import add_block
from rs_localizer.core.camera import Camera, numbers
from rs_localizer.core.state import PARAMETERS
from rs_localizer.native import entry

Numbers = tuple[Array2, Array1, Array1, Array1, Array1, Array1]
"""The fields of a :class:`Motion`, in their order, as kernels take them."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A camera pose at the middle row and how it changes during the readout (see the module)."""

    rotation: Array  # (3,3) camera_from_map at tau = 0
    translation: Array  # (3,) m, camera_from_map at tau = 0
    angular_velocity: Array  # (3,) rad per readout, body rate in camera axes at tau = 0
    linear_velocity: Array  # (3,) m per readout, of the camera centre, in camera axes at tau = 0
    # (3,) rad and m per readout squared, in camera axes at tau = 0
    angular_acceleration: Array = field(default_factory=lambda: np.zeros(3), kw_only=True)
    linear_acceleration: Array = field(default_factory=lambda: np.zeros(3), kw_only=True)

    def at(self, tau: float) -> tuple[Array, Array]:
        """Return the rotation (3,3) and translation (3,) camera_from_map at row time ``tau``."""
        turn = so3.exp(-self.angle_at(tau))
        return turn @ self.rotation, turn @ (self.translation - self.way_at(tau))

    def at_rows(self, tau: Array) -> tuple[Array, Array]:
        """Return the rotations (n,3,3) and translations (n,3) camera_from_map at row times (n,)."""
        rows = numbers("tau", tau, np.ascontiguousarray)
        if rows.ndim != 1:
            raise ValueError(f"tau must be row times of shape (n,), got {rows.shape}")
        return _at_rows(numbers_of(self), rows)

    def angle_at(self, tau: Any) -> Array:
        """Return the rotation vector (3,), rad, from the middle row to ``tau``."""
        angle: Array = tau * self.angular_velocity + 0.5 * tau * tau * self.angular_acceleration
        return angle

    def way_at(self, tau: Any) -> Array:
        """Return the displacement (3,) of the centre since the middle row, in axes of tau = 0."""
        displacement: Array = (
            tau * self.linear_velocity + 0.5 * tau * tau * self.linear_acceleration
        )
        return displacement

    def angular_velocity_at(self, tau: float) -> Array:
        """Return the body rate (3,), rad per readout, in the camera axes at ``tau``."""
        rate = self.angular_velocity + tau * self.angular_acceleration
        body_rate: Array = so3.right_jacobian(self.angle_at(tau)) @ rate
        return body_rate

    def linear_velocity_at(self, tau: float) -> Array:
        """Return the velocity (3,) of the centre, m per readout, in the camera axes at ``tau``."""
        velocity = self.linear_velocity + tau * self.linear_acceleration
        return so3.exp(-self.angle_at(tau)) @ velocity


def numbers_of(motion: Motion) -> Numbers:
    """Return the numbers of a motion, as kernels take them."""
    return (
        np.ascontiguousarray(motion.rotation, np.float64),
        np.ascontiguousarray(motion.translation, np.float64),
        np.ascontiguousarray(motion.angular_velocity, np.float64),
        np.ascontiguousarray(motion.linear_velocity, np.float64),
        np.ascontiguousarray(motion.angular_acceleration, np.float64),
        np.ascontiguousarray(motion.linear_acceleration, np.float64),
    )


def motion_of(numbers: Numbers) -> Motion:
    """Return the motion with these numbers."""
    *velocities, change, acceleration = numbers
    return Motion(*velocities, angular_acceleration=change, linear_acceleration=acceleration)


@entry
def _at_rows(motion: Numbers, tau: Array1) -> tuple[Array, Array]:
    """Return the rotations (n,3,3) and translations (n,3) at row times (n,)."""
    rotation, translation, angular, linear, change, acceleration = motion
    rotations, translations = np.empty((len(tau), 3, 3)), np.empty((len(tau), 3))
    angle = np.empty(3)
    for i in range(len(tau)):
        time, half = tau[i], 0.5 * tau[i] * tau[i]
        for k in range(3):
            angle[k] = -(time * angular[k] + half * change[k])
        turn = so3.exp(angle)
        for row in range(3):
            moved = 0.0
            for k in range(3):
                way = time * linear[k] + half * acceleration[k]
                moved += turn[row, k] * (translation[k] - way)
            translations[i, row] = moved
            for column in range(3):
                turned = 0.0
                for k in range(3):
                    turned += turn[row, k] * rotation[k, column]
                rotations[i, row, column] = turned
    return rotations, translations


@entry
def carried(motion: Numbers, readouts: float, fading: float) -> tuple[Numbers, Array]:
    """Return the motion some readout times later or earlier, and its derivative (18,18)."""
    rotation, translation, angular, linear, change, acceleration = motion
    left = math.exp(-readouts / fading)
    # Contribution of a unit of acceleration to the velocity and to the displacement.
    faster = -fading * math.expm1(-readouts / fading)
    farther = fading * (readouts - faster)
    angle = readouts * angular + farther * change
    way = readouts * linear + farther * acceleration
    back = so3.exp(-angle)  # then_from_now
    turned = so3.right_jacobian_of(angle)
    velocity = back @ (linear + faster * acceleration)
    # Without acceleration the body rate stays what it is, however far the camera turns.
    mean = farther / readouts if readouts != 0.0 else 0.0
    across, unit = so3.hat_of(velocity) @ turned, np.eye(3)
    transport = np.zeros((PARAMETERS, PARAMETERS))
    for row, column, factor, block in (
        (0, 0, 1.0, back),
        (0, 6, readouts, turned),
        (0, 12, farther, turned),
        (3, 3, 1.0, back),
        (3, 0, -1.0, back @ so3.hat_of(way)),
        (3, 9, readouts, back),
        (3, 15, farther, back),
        (9, 9, 1.0, back),
        (9, 15, faster, back),
        (15, 15, left, back),
        (9, 6, readouts, across),
        (9, 12, farther, across),
        (6, 12, faster - mean, turned),
        (6, 6, 1.0, unit),
        (6, 12, mean, unit),
        (12, 12, left, unit),
    ):
        add_block(transport, row, column, factor, block)
    later = (
        back @ rotation, back @ (translation - way), turned @ (angular + faster * change), velocity,
        left * change, left * (back @ acceleration),
    )  # fmt: skip
    return later, transport


# Secant steps double the digits; even rows that overtake the image settle well before this.
_MOST_STEPS = 50
_ROW_TIME_TOLERANCE = 1e-12


def project_rolling(
    camera: Camera, poses_at: Callable[[Array], tuple[Array, Array]], points: Array
) -> tuple[Array, Array]:
    """Return the raw pixels and row times at which a moving rolling shutter sees points.

    Solves the implicit equation ``row_time(project(pose(tau), X)) = tau`` for each point.

    Args:
        camera: intrinsics, distortion and scan direction.
        poses_at: row times (n,) -> rotations (n,3,3), translations (n,3) camera_from_map, one
            pose per point (``Motion.at_rows`` or any other motion).
        points: (n,3) map frame, metres.

    Returns:
        pixels (n,2) and row times (n,); NaN where the point is behind the camera, or where no row
        sees it (the iteration does not settle).
    """
    points = np.asarray(points, float)

    def view(tau: Array) -> tuple[Array, Array]:
        rotations, translations = poses_at(tau)
        pixels = camera.project(np.einsum("nij,nj->ni", rotations, points) + translations)
        return pixels, camera.row_time(pixels)

    before = np.zeros(len(points))
    error_before = view(before)[1] - before
    tau = before + error_before
    for _ in range(_MOST_STEPS):
        error = view(tau)[1] - tau
        moving = np.abs(error) > _ROW_TIME_TOLERANCE
        if not np.any(moving):
            break
        with np.errstate(all="ignore"):  # points that no row sees end as NaN
            step = -error * (tau - before) / (error - error_before)
        before, error_before = tau, error
        tau = np.where(moving, tau + step, tau)
    pixels, row_time = view(tau)
    settled = np.abs(row_time - tau) < 1e3 * _ROW_TIME_TOLERANCE  # NaN compares false
    return np.where(settled[:, None], pixels, np.nan), np.where(settled, tau, np.nan)
