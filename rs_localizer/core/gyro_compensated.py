# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Image points as a camera without the known turn would see them.

Row by row the bearings are turned back into the axes of the middle row, so that all that follows
sees a camera that hardly turns. A point's row is measured with its pixel, and with it the turn: of
the pixels' noise ``n`` the model explains ``m g^T n``, where ``g`` is the gradient of the row time
and ``m`` the velocity of the image point (as the module ``view`` of the estimation says). The part
``k`` of ``m`` that is the known turn's is taken care of here, because

    I - (k + m) g^T = (I - k g^T) (I - m' g^T),   m' = (I - k g^T)^-1 m

so that derivatives of the pixel by the compensated bearing times ``(I - k g^T)^-1`` are all that
the kernels need.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.gyro_rotation import GyroRotation, find_turn
from rs_localizer.core.simd.jit import kernel

# Image points that nearly keep pace with the rows.
_LEAST_PACE = 0.1
# Bearings that the turn takes out of the camera's front have no place in its image.
_LEAST_FRONT = 1e-3


def gyro_compensated(
    rays: Array, tau: Array, by_ray: Array, gradient: Array, turn: GyroRotation
) -> tuple[Array, Array]:
    """Bearings (n,2) and derivatives (n,2,2) of the pixels by them, with a known turn taken out.

    Args:
        rays: (n,2) as measured; NaN stays NaN.
        tau: (n,) row times.
        by_ray: (n,2,2) derivatives of the raw pixels by the rays.
        gradient: (2,) of the row time by the pixel.
    """
    compensated: tuple[Array, Array] = _gyro_compensated(rays, tau, by_ray, gradient, *turn.spline)
    return compensated


@kernel
def _gyro_compensated(
    rays: Array, tau: Array, by_ray: Array, gradient: Array,
    times: Array, cubics: Array, rotations: Array, parabola: Array,
) -> tuple[Array, Array]:  # fmt: skip
    count = len(rays)
    turned, by_turned = np.empty((count, 2)), np.empty((count, 2, 2))
    rotation, rate = np.empty((3, 3)), np.empty(3)
    step, pixel, moved = np.empty((2, 2)), np.empty((2, 2)), np.empty(2)
    for i in range(count):
        x, y = rays[i, 0], rays[i, 1]
        if not np.isfinite(x + y + tau[i]):
            turned[i] = np.nan
            by_turned[i] = np.nan
            continue
        find_turn(tau[i], times, cubics, rotations, parabola, rotation, rate)
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
            moved[row] = by_ray[i, row, 0] * ray_rate_x + by_ray[i, row, 1] * ray_rate_y
            for j in range(2):
                pixel[row, j] = by_ray[i, row, 0] * step[0, j] + by_ray[i, row, 1] * step[1, j]
        pace = max(1.0 - gradient[0] * moved[0] - gradient[1] * moved[1], _LEAST_PACE)
        for row in range(2):
            for j in range(2):
                along = gradient[0] * pixel[0, j] + gradient[1] * pixel[1, j]
                by_turned[i, row, j] = pixel[row, j] + moved[row] / pace * along
    return turned, by_turned
