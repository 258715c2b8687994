# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The rotation within a frame as a gyroscope measures it: a mean and a covariance.

The mean is taken out of the points, row by row (:func:`compensated`), so that all that follows sees
a camera that hardly turns. The errors of the mean are unknowns of the fit: a rate, its change, and
the coefficients of an in-frame turn (:mod:`rs_localizer.estimation.known_rotation`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, Array1, Array2, Array3
from rs_localizer.core.shake import (
    FUNCTIONS,
    MIDDLE_RATES,
    RESOLVED,
    TYPICAL_SIZES,
    shake_basis,
    shake_functions,
)
from rs_localizer.core.state import ANGULAR, ANGULAR_ACCELERATION, PARAMETERS
from rs_localizer.core.types import Estimate
from rs_localizer.native import entry

WHOLE = PARAMETERS + 3 * RESOLVED
"""Numbers of a motion and of an in-frame turn."""
ROTATION = np.r_[ANGULAR, ANGULAR_ACCELERATION, PARAMETERS:WHOLE]
"""Places of the numbers of a rotation among those of motion and in-frame turn."""
_RATES = np.ix_(ROTATION[:6], ROTATION[:6])

NODES = np.linspace(-0.52, 0.52, 53)
"""Row times at which rotations are compared."""
_VALUES = np.ascontiguousarray(shake_functions(NODES)[0])
# rad of a rotation that is rounding.
_RIDGE = 1e-7
# Image points that nearly keep pace with the rows.
_LEAST_PACE = 0.1
# Bearings that the turn takes out of the camera's front have no place in its image.
_LEAST_FRONT = 1e-3


def _parts_by_turns() -> Array:
    """Return the derivatives (30,n) of rate, change and coefficients by turns at the nodes."""
    shown = np.column_stack([NODES, 0.5 * NODES**2, _VALUES])
    sizes = np.repeat(TYPICAL_SIZES, 2)
    scale = np.r_[1.0, 1.0, sizes]  # as little vibration as can be
    left, sizes, right = np.linalg.svd(shown * scale, full_matrices=False)
    half = right.T * (sizes / (sizes**2 + _RIDGE**2))
    return np.ascontiguousarray(scale[:, None] * (half @ left.T))


_PARTS = _parts_by_turns()


@dataclass(frozen=True, slots=True, eq=False)
class RotationPrior:
    """Knowledge of the rotation within a frame; row times count, rates are per readout."""

    rate: Array  # (3,) rad, at the middle row
    change: Array  # (3,) rad, there
    shake: Array  # (28,3) rad, see rs_localizer.core.shake
    # (72,72) of motion (but for its vibration) and in-frame turn beside that; of the rotation
    # alone if nothing predicts the motion, see ROTATION
    covariance: Array
    predicted: bool  # whether it is of the motion, too

    @property
    def smooth_rate(self) -> Array:
        """(3,) the rate without its vibration."""
        rate: Array = self.rate - MIDDLE_RATES @ self.shake
        return rate

    @property
    def error(self) -> Array:
        """(6,6) covariance of rate and change."""
        return self.covariance[_RATES]

    def at_rows(self, tau: Array) -> tuple[Array, Array]:
        """Return rotations (n,3,3) camera_then_from_camera_at_tau_0 and body rates (n,3)."""
        rows = np.ascontiguousarray(tau, np.float64)
        turned: tuple[Array, Array] = _turned(rows, self.rate, self.change, self.shake)
        return turned

    def beside(self, estimate: Estimate) -> Estimate:
        """Return an estimate with what it knows taken out."""
        shake = estimate.shake if len(estimate.shake) else np.zeros_like(self.shake)
        return replace(
            estimate,
            angular_velocity=estimate.angular_velocity - self.rate,
            angular_acceleration=estimate.angular_acceleration - self.change,
            shake=shake - self.shake,
        )

    def joined(self, rate: Array, change: Array, shake: Array) -> tuple[Array, Array, Array]:
        """Return rate, change and coefficients of the rotation with another one beside it.

        It is right to first order, because the other rotation is small.
        """
        beside = shake if len(shake) else np.zeros_like(self.shake)
        return self.rate + rate, self.change + change, self.shake + beside


def parts_of(rotations: Array) -> tuple[Array, Array, Array]:
    """Return rate, change (3,) and coefficients (28,3) of rotations (n,3,3) at the nodes."""
    parts: Array = _parts_of(np.ascontiguousarray(rotations))
    return parts[0], parts[1], parts[2:]


@entry
def after(turns: Array2) -> Array:
    """Return rotations (n+1,3,3) camera_then_from_camera_first, by turns (n,3) of the camera."""
    rotations = np.empty((len(turns) + 1, 3, 3))
    rotations[0] = np.eye(3)
    for i in range(len(turns)):
        rotations[i + 1] = so3.exp(-turns[i]) @ rotations[i]
    return rotations


@entry
def _parts_of(rotations: Array3) -> Array:
    parts, off = np.zeros((2 + FUNCTIONS, 3)), np.empty((len(rotations), 3))
    for _ in range(3):  # Gauss-Newton; rotations are small
        swings = _VALUES @ parts[2:].copy()
        for i in range(len(rotations)):
            angle = NODES[i] * parts[0] + 0.5 * NODES[i] * NODES[i] * parts[1]
            here = so3.exp(-swings[i]) @ so3.exp(-angle)
            off[i] = so3.log(np.ascontiguousarray(here @ rotations[i].T))
        parts += _PARTS @ off
    return parts


@entry
def _turned(tau: Array1, rate: Array1, change: Array1, shake: Array2) -> tuple[Array, Array]:
    """Return rotations (n,3,3) and body rates (n,3) at row times, beyond the rows, too."""
    rotations, rates = np.empty((len(tau), 3, 3)), np.empty((len(tau), 3))
    values, slopes = np.empty(FUNCTIONS), np.empty(FUNCTIONS)
    for i in range(len(tau)):
        shake_basis(tau[i], values, slopes)
        swing, slope = values @ shake, slopes @ shake
        angle = tau[i] * rate + 0.5 * tau[i] * tau[i] * change
        back = so3.exp(-swing)
        rotations[i] = back @ so3.exp(-angle)
        rates[i] = back @ (so3.right_jacobian_of(angle) @ (rate + tau[i] * change))
        rates[i] += so3.right_jacobian_of(swing) @ slope
    return rotations, rates


def compensated(
    rays: Array, tau: Array, by_ray: Array, gradient: Array, rotation: RotationPrior
) -> tuple[Array, Array]:
    """Return bearings (n,2) without a known rotation, and derivatives (n,2,2) of pixels by them.

    Row by row the bearings are turned back into the axes of the middle row. A point's row is
    measured with its pixel, and with it the turn: of the pixels' noise ``n`` the model explains ``m
    g^T n``, where ``g`` is the gradient of the row time and ``m`` the velocity of the image point
    (:mod:`.estimation.residuals`). The part ``k`` of ``m`` that is the known turn's is taken care
    of here, because

        I - (k + m) g^T = (I - k g^T) (I - m' g^T),   m' = (I - k g^T)^-1 m

    so that derivatives of the pixel by the compensated bearing times ``(I - k g^T)^-1`` are all
    that the kernels need.

    Args:
        rays: (n,2) as measured; NaN stays NaN.
        tau: (n,) row times.
        by_ray: (n,2,2) derivatives of the raw pixels by the rays.
        gradient: (2,) of the row time by the pixel.
    """
    found: tuple[Array, Array] = _compensated(
        rays, tau, by_ray, gradient, *rotation.at_rows(np.where(np.isfinite(tau), tau, 0.0))
    )
    return found


@entry
def _compensated(
    rays: Array2, tau: Array1, by_ray: Array3, gradient: Array1, rotations: Array3, rates: Array2
) -> tuple[Array, Array]:
    count = len(rays)
    turned, by_turned = np.empty((count, 2)), np.empty((count, 2, 2))
    step, pixel, moving = np.empty((2, 2)), np.empty((2, 2)), np.empty(2)
    for i in range(count):
        x, y = rays[i, 0], rays[i, 1]
        if not np.isfinite(x + y + tau[i]):
            turned[i] = np.nan
            by_turned[i] = np.nan
            continue
        rotation, rate = rotations[i], rates[i]
        # The bearing in the axes of the middle row.
        u = rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0]
        v = rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1]
        w = rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2]
        if not w > _LEAST_FRONT:
            turned[i] = np.nan
            by_turned[i] = np.nan
            continue
        turned[i, 0], turned[i, 1] = u / w, v / w
        # The ray by the compensated one.
        for j in range(2):
            step[0, j] = w * (rotation[0, j] - x * rotation[2, j])
            step[1, j] = w * (rotation[1, j] - y * rotation[2, j])
        # Velocity of the image point by the turn alone: the point moves by -rate x (x, y, 1).
        depth_rate = rate[1] * x - rate[0] * y
        ray_rate_x = rate[2] * y - rate[1] - x * depth_rate
        ray_rate_y = rate[0] - rate[2] * x - y * depth_rate
        for row in range(2):
            moving[row] = by_ray[i, row, 0] * ray_rate_x + by_ray[i, row, 1] * ray_rate_y
            for j in range(2):
                pixel[row, j] = by_ray[i, row, 0] * step[0, j] + by_ray[i, row, 1] * step[1, j]
        pace = max(1.0 - gradient[0] * moving[0] - gradient[1] * moving[1], _LEAST_PACE)
        for row in range(2):
            for j in range(2):
                along = gradient[0] * pixel[0, j] + gradient[1] * pixel[1, j]
                by_turned[i, row, j] = pixel[row, j] + moving[row] / pace * along
    return turned, by_turned
