# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What one image says of its motion, without any prior: a Gaussian about an estimate of it."""

from __future__ import annotations

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.blocks import write
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion
from rs_localizer.core.simd.jit import inlined, kernel

# Directions that the image does not see: least eigenvalue of the information, diagonal scaled to 1.
_LEAST_EIGENVALUE = 1e-9
_LEAST_PACE = 0.1  # where rows overtake the image points, they say nothing
_LEAST_NOISE = 1e-4  # px
_PARAMETERS = 12
# A step in directions that the image hardly sees would leave the range of the linear model: the
# velocities stay within about this (rad, m per readout) of the given ones. The covariance says
# that such directions are not known.
_HELD = np.repeat([0.0, 0.0, 0.05**-2, 0.05**-2], 3)


def single_image_likelihood(
    camera: Camera, motion: Motion, points: Array, pixels: Array
) -> tuple[Array, Array] | None:
    """The step (12,) from a motion to what the image says, and its covariance (12,12).

    Order and units as of ``Estimate.covariance``: one Gauss-Newton step of the constant-velocity
    model on points (n,3) and raw pixels (n,2), all of them inliers, whose noise it leaves is
    theirs. None when they are too few.
    """
    if len(points) <= _PARAMETERS:
        return None
    tau = camera.row_time(pixels)
    omega, v = motion.angular_velocity, motion.linear_velocity
    turns, local = _seen(motion.rotation, motion.translation, omega, v, points, tau)
    seen, by_ray = camera.distort(local[:, :2] / np.where(local[:, 2:] > 0.0, local[:, 2:], 1.0))
    information, slope, squared, count = _normal(
        turns, local, tau, omega, v, seen - pixels, by_ray, camera.row_time_gradient
    )
    if count <= _PARAMETERS:
        return None
    variance = max(squared / (2 * count - _PARAMETERS), _LEAST_NOISE**2)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    basis = scale[:, None] * vectors
    inverse = basis / np.maximum(values, _LEAST_EIGENVALUE) @ basis.T
    held = information + np.diag(variance * _HELD)
    return np.asarray(np.linalg.solve(held, -slope), np.float64), variance * inverse


@kernel
def _seen(
    rotation: Array, translation: Array, omega: Array, v: Array, points: Array, tau: Array
) -> tuple[Array, Array]:
    """Turns (n,3,3) from the middle row to each point's, and the points (n,3) in its axes."""
    count = len(points)
    turns, local = np.empty((count, 3, 3)), np.empty((count, 3))
    there = np.empty(3)
    for n in range(count):
        write(turns[n], so3.exp(-tau[n] * omega))
        for i in range(3):
            there[i] = translation[i] - tau[n] * v[i]
            for j in range(3):
                there[i] += rotation[i, j] * points[n, j]
        for i in range(3):
            local[n, i] = (
                turns[n, i, 0] * there[0] + turns[n, i, 1] * there[1] + turns[n, i, 2] * there[2]
            )
    return turns, local


@kernel
def _normal(
    turns: Array, local: Array, tau: Array, omega: Array, v: Array, errors: Array, by_ray: Array,
    gradient: Array,
) -> tuple[Array, Array, float, int]:  # fmt: skip
    """Normal equations (12,12) and (12,), sum of the squared errors, and how many points count.

    Noise moves a pixel to another row, too: errors and derivatives are multiplied by the inverse of
    ``I - flow gradient^T``, where ``flow`` is the pixel's motion in one readout.

    Args:
        turns, local: see :func:`_seen`.
        errors: (n,2) predicted less measured pixels.
        by_ray: (n,2,2) of the pixels by the rays.
        gradient: (2,) of the row time by the pixel.
    """
    information, slope = np.zeros((_PARAMETERS, _PARAMETERS)), np.zeros(_PARAMETERS)
    squared, used = 0.0, 0
    by_point, whitener, row = np.empty((2, 3)), np.empty((2, 2)), np.empty((2, _PARAMETERS))
    flow, error, moving = np.empty(2), np.empty(2), np.empty(3)
    g, turned, work = np.empty(3), np.empty(3), np.empty((4, 3))
    for n in range(len(local)):
        point = local[n]
        if not point[2] > 0.0:
            continue
        _cross(point, omega, moving)
        for i in range(3):
            for j in range(3):
                moving[i] -= turns[n, i, j] * v[j]
        for i in range(2):
            a, b = by_ray[n, i, 0] / point[2], by_ray[n, i, 1] / point[2]
            by_point[i, 0], by_point[i, 1] = a, b
            by_point[i, 2] = -(a * point[0] + b * point[1]) / point[2]
            flow[i] = a * moving[0] + b * moving[1] + by_point[i, 2] * moving[2]
        pace = 1.0 - flow[0] * gradient[0] - flow[1] * gradient[1]
        for i in range(2):
            for j in range(2):
                whitener[i, j] = flow[i] * gradient[j] / pace
            whitener[i, i] += 1.0
            error[i] = whitener[i, 0] * errors[n, 0] + whitener[i, 1] * errors[n, 1]
        if not (abs(pace) > _LEAST_PACE and np.isfinite(error[0]) and np.isfinite(error[1])):
            continue
        used += 1
        for i in range(2):
            squared += error[i] * error[i]
            for k in range(3):
                g[k] = whitener[i, 0] * by_point[0, k] + whitener[i, 1] * by_point[1, k]
            for k in range(3):
                turned[k] = g[0] * turns[n, 0, k] + g[1] * turns[n, 1, k] + g[2] * turns[n, 2, k]
            _line(g, turned, point, turns[n], tau[n], omega, v, work, row[i])
        for k in range(_PARAMETERS):
            slope[k] += row[0, k] * error[0] + row[1, k] * error[1]
            for m in range(_PARAMETERS):
                information[k, m] += row[0, k] * row[0, m] + row[1, k] * row[1, m]
    return information, slope, squared, used


@inlined
def _line(
    g: Array, turned: Array, point: Array, turn: Array, tau: float, omega: Array, v: Array,
    work: Array, line: Array,
) -> None:  # fmt: skip
    """Derivatives (12,) by the motion, from those ``g`` (3,) by the point in the row's axes.

    ``turned`` is ``g`` in the axes of the middle row.
    """
    by_turn, along, first, second = work[0], work[1], work[2], work[3]
    _cross(g, point, by_turn)
    _cross(turned, v, along)
    # The right Jacobian of the turn, to second order.
    _cross(by_turn, omega, first)
    _cross(first, omega, second)
    for k in range(3):
        line[k] = tau * along[k]
        for i in range(3):
            line[k] += by_turn[i] * turn[i, k]
        line[3 + k] = -turned[k]
        line[6 + k] = tau * (by_turn[k] - 0.5 * tau * first[k] + tau * tau / 6.0 * second[k])
        line[9 + k] = -tau * turned[k]


@kernel
def _cross(a: Array, b: Array, out: Array) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
