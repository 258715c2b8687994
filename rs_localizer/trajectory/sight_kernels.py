# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Reprojection errors along a spline and their derivatives, compiled.

A keypoint is compared with the projection of its landmark at the time of its own row. Noise moves
the keypoint to another row, too, so that the error has the covariance ``s^2 A A^T`` with
``A = I - flow g^T``: ``flow`` is the pixel's motion in one readout, ``g`` the row time's gradient.
Errors and derivatives are multiplied by the inverse of ``A`` and weighted by Tukey's biweight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.simd.jit import kernel
from rs_localizer.trajectory.spline_kernels import (
    CONTROL,
    LOCAL,
    ORDER,
    cumulative,
    pose,
    pull_back,
    rates,
)

EXTRINSICS = 7
"""Numbers of a camera's mount: turn in its own axes, centre in the body's, offset of its clock."""

# Where the rows overtake the image points to within this share, a keypoint's row says nothing.
_LEAST_PACE = 0.1


class Curve(NamedTuple):
    """A spline and what is computed of it once per step."""

    rotations: Array  # (n,3,3)
    positions: Array  # (n,3)
    vectors: Array  # (n,3) from control to control
    inverses: Array  # (n,3,3)
    spacing: float


class Sights(NamedTuple):
    """Keypoints, where on the spline they are seen, and what the lens makes of them."""

    first: IntArray  # (n,) first of the four controls
    u: Array  # (n,)
    tau: Array  # (n,) row time
    local: Array  # (n,3) landmark in camera axes
    velocity: Array  # (n,3) its velocity, m/s
    errors: Array  # (n,2) predicted less measured pixel
    by_ray: Array  # (n,2,2)
    by_lens: Array  # (n,2,m)
    slots: IntArray  # (n,) place of the landmark, or its body, among the free ones; -1: known
    arms: Array  # (n,3) from the middle of its body to the landmark, along the map's axes
    frames: IntArray  # (n,) number of the image
    # Where the camera is mounted on what moves along the spline: X_camera = axes (X_body - centre).
    axes: Array  # (3,3)
    centre: Array  # (3,)


class Terms(NamedTuple):
    """What is free beside the controls, and the noise."""

    readout_time: float
    gradient: Array  # (2,) of the row time by the pixel
    # The border has these columns, one after the other: readout time, lens, mount, landmarks.
    readout_free: bool
    lens_free: bool
    mount_free: bool  # its columns follow those of the lens
    point_column: int  # first of the landmarks' columns; -1: all known
    point_width: int  # columns of each: 3 for the place, 6 for a rigid body's turn as well
    stamps_free: bool  # each image has a time of its own
    variance: float  # px^2, of the noise of u and of v
    limit: float  # px^2, where Tukey's weight ends


@kernel
def look(
    curve: Curve, first: IntArray, u: Array, points: Array, axes: Array, centre: Array,
    local: Array, velocity: Array,
) -> None:  # fmt: skip
    """Points (n,3) in camera axes at their own times, and their velocities there."""
    work, rotation, position = np.empty((8, 3, 3)), np.empty((3, 3)), np.empty(3)
    rate, away, moving = np.empty((4, 3)), np.empty(3), np.empty(3)
    for n in range(len(first)):
        pose(curve.rotations, curve.positions, curve.vectors, first[n], u[n], work, rotation,
             position)  # fmt: skip
        rates(curve.positions, curve.vectors, first[n], u[n], curve.spacing, work, rotation, rate)
        for i in range(3):
            away[i] = points[n, i] - position[i]
        for i in range(3):
            local[n, i] = (
                rotation[0, i] * away[0] + rotation[1, i] * away[1] + rotation[2, i] * away[2]
            )
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            moving[i] = (
                rate[0, b] * local[n, a]
                - rate[0, a] * local[n, b]
                - rotation[0, i] * rate[1, 0]
                - rotation[1, i] * rate[1, 1]
                - rotation[2, i] * rate[1, 2]
            )
        for i in range(3):
            away[i] = local[n, i] - centre[i]
        for i in range(3):
            local[n, i] = axes[i, 0] * away[0] + axes[i, 1] * away[1] + axes[i, 2] * away[2]
            velocity[n, i] = (
                axes[i, 0] * moving[0] + axes[i, 1] * moving[1] + axes[i, 2] * moving[2]
            )


@kernel
def _whitened(sights: Sights, terms: Terms, n: int, by_point: Array, flow: Array) -> bool:
    """Fill the whitened derivative (2,3) of the pixel by the camera point; false if useless.

    With the inverse of A (rows 2 and 3 of ``flow``) and the unwhitened flow per second (row 0).
    """
    x, y, z = sights.local[n, 0], sights.local[n, 1], 1.0 / sights.local[n, 2]
    for i in range(2):
        a, b = sights.by_ray[n, i, 0] * z, sights.by_ray[n, i, 1] * z
        by_point[i, 0], by_point[i, 1], by_point[i, 2] = a, b, -(a * x + b * y) * z
        total = 0.0
        for j in range(3):
            total += by_point[i, j] * sights.velocity[n, j]
        flow[0, i] = total
    pace = 1.0 - terms.readout_time * (
        terms.gradient[0] * flow[0, 0] + terms.gradient[1] * flow[0, 1]
    )
    if not (sights.local[n, 2] > 0.0 and abs(pace) > _LEAST_PACE):
        return False
    for i in range(2):
        for j in range(2):
            flow[2 + i, j] = terms.readout_time * flow[0, i] * terms.gradient[j] / pace
        flow[2 + i, i] += 1.0
    for j in range(3):
        a, b = by_point[0, j], by_point[1, j]
        by_point[0, j] = flow[2, 0] * a + flow[2, 1] * b
        by_point[1, j] = flow[3, 0] * a + flow[3, 1] * b
    return True


@kernel
def squared_errors(sights: Sights, terms: Terms, out: Array) -> None:
    """Squared whitened errors (n,), px^2; infinite for keypoints that say nothing."""
    by_point, flow = np.empty((2, 3)), np.empty((4, 2))
    for n in range(len(sights.first)):
        if _whitened(sights, terms, n, by_point, flow):
            e = sights.errors[n]
            a = flow[2, 0] * e[0] + flow[2, 1] * e[1]
            b = flow[3, 0] * e[0] + flow[3, 1] * e[1]
            out[n] = a * a + b * b
        else:
            out[n] = np.inf


class Row(NamedTuple):
    """Derivatives of one keypoint's whitened error, and what they are computed with."""

    error: Array  # (2,)
    by_controls: Array  # (2,24)
    by_shared: Array  # (2,s) readout time, lens and mount, as far as they are free
    by_landmark: Array  # (2,3) along the map's axes
    by_time: Array  # (2,) per second
    work: Array  # (8,3,3)
    rotation: Array  # (3,3)
    position: Array  # (3,)
    by_point: Array  # (2,3)
    flow: Array  # (4,2)


@kernel
def make_row(sights: Sights, terms: Terms) -> Row:
    """Room for the derivatives of one keypoint after the other."""
    shared = (1 if terms.readout_free else 0) + (sights.by_lens.shape[2] if terms.lens_free else 0)
    shared += EXTRINSICS if terms.mount_free else 0
    return Row(
        np.empty(2), np.zeros((2, LOCAL)), np.empty((2, shared)), np.empty((2, 3)), np.empty(2),
        np.empty((8, 3, 3)), np.empty((3, 3)), np.empty(3), np.empty((2, 3)), np.empty((4, 2)),
    )  # fmt: skip


@kernel
def _to_body(
    sights: Sights, terms: Terms, n: int, row: Row, r: int, gradient: Array, point: Array
) -> None:
    """Fill the derivative (3,) of coordinate r and the landmark (3,) along the body's axes.

    And the derivatives by the mount, where it is free.
    """
    axes, g, p = sights.axes, row.by_point[r], sights.local[n]
    for i in range(3):
        gradient[i] = 0.0
        point[i] = sights.centre[i]
        for j in range(3):
            gradient[i] += axes[j, i] * g[j]
            point[i] += axes[j, i] * p[j]
    if terms.mount_free:
        first = row.by_shared.shape[1] - EXTRINSICS
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            row.by_shared[r, first + i] = p[a] * g[b] - p[b] * g[a]
            row.by_shared[r, first + 3 + i] = -gradient[i]
        row.by_shared[r, first + 6] = row.by_time[r]


@kernel
def differentiate(
    curve: Curve, sights: Sights, terms: Terms, n: int, row: Row
) -> tuple[float, float]:
    """Fill the row of keypoint n; returns its weight (0: the row is not filled) and its cost."""
    full = terms.limit / (3.0 * terms.variance)
    flow, error, by_point = row.flow, row.error, row.by_point
    if not _whitened(sights, terms, n, by_point, flow):
        return 0.0, full
    for i in range(2):
        error[i] = flow[2 + i, 0] * sights.errors[n, 0] + flow[2 + i, 1] * sights.errors[n, 1]
    rest = 1.0 - (error[0] * error[0] + error[1] * error[1]) / terms.limit
    if not rest > 0.0:
        return 0.0, full
    rotation, turn, basis = row.rotation, row.position, row.work[7, 2]
    shared = row.by_shared.shape[1] - (EXTRINSICS if terms.mount_free else 0)
    pose(curve.rotations, curve.positions, curve.vectors, sights.first[n], sights.u[n], row.work,
         rotation, row.position)  # fmt: skip
    for r in range(2):
        row.by_time[r] = flow[2 + r, 0] * flow[0, 0] + flow[2 + r, 1] * flow[0, 1]
        g, p = row.work[7, 0], row.work[7, 1]
        _to_body(sights, terms, n, row, r, g, p)
        turn[0] = g[1] * p[2] - g[2] * p[1]  # the position is not needed any more
        turn[1] = g[2] * p[0] - g[0] * p[2]
        turn[2] = g[0] * p[1] - g[1] * p[0]
        pull_back(turn, curve.inverses, sights.first[n], row.work, row.by_controls[r])
        count = 0
        if terms.readout_free:
            row.by_shared[r, 0] = sights.tau[n] * row.by_time[r]
            count = 1
        for k in range(shared - count):
            row.by_shared[r, count + k] = (
                flow[2 + r, 0] * sights.by_lens[n, 0, k] + flow[2 + r, 1] * sights.by_lens[n, 1, k]
            )
        cumulative(sights.u[n], 0, basis)
        for i in range(3):
            moved = rotation[i, 0] * g[0] + rotation[i, 1] * g[1] + rotation[i, 2] * g[2]
            row.by_landmark[r, i] = moved
            for k in range(ORDER):
                share = 1.0 if k == 0 else basis[k - 1]
                if k < 3:
                    share -= basis[k]
                row.by_controls[r, CONTROL * k + 3 + i] = -share * moved
    return rest * rest / terms.variance, (1.0 - rest * rest * rest) * full
