# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Kernels of reprojections on a spline, and of the normal equations that their rows make up."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, Array3, IntArray1, IntArray2, Out
from rs_localizer.native import entry, kernel
from rs_localizer.tools.adjust.spline_kernels import (
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

# If the rows overtake the image points to within this share, a keypoint's row determines nothing.
_LEAST_PACE = 0.1


class Curve(NamedTuple):
    """A spline and the products that are computed once per step."""

    rotations: Array3  # (n,3,3)
    positions: Array2  # (n,3)
    vectors: Array2  # (n,3) from control to control
    inverses: Array3  # (n,3,3)
    spacing: float


class Projections(NamedTuple):
    """Keypoints, where on the spline they are seen, and what the lens makes of them."""

    first: IntArray1  # (n,) first of the four controls
    u: Array1  # (n,)
    tau: Array1  # (n,) row time
    local: Array2  # (n,3) landmark in camera axes
    velocity: Array2  # (n,3) its velocity, m/s
    errors: Array2  # (n,2) predicted less measured pixel
    by_ray: Array3  # (n,2,2)
    by_lens: Array3  # (n,2,m)
    arms: Array2  # (n,3) from the middle of its body to the landmark, along the map's axes
    # Mount of the camera on the body that moves along the spline: X_camera = axes (X_body -
    # centre).
    axes: Array2  # (3,3)
    centre: Array1  # (3,)


class Terms(NamedTuple):
    """Unknowns beside the controls, in the order of a row's columns, and the noise."""

    readout_time: float
    gradient: Array1  # (2,) of the row time by the pixel
    readout_free: bool
    lens_free: bool
    mount_free: bool
    # 3 for the place of a landmark, 6 for a rigid body's turn as well, 7 for its size; 0: known
    point_width: int
    delay_free: bool  # each image has a time of its own
    variance: float  # px^2, of the noise of u and of v
    limit: float  # px^2, where Tukey's weight ends


@entry
def look(
    curve: Curve, first: IntArray1, u: Array1, points: Array2, axes: Array2, centre: Array1,
    local: Out[Array2], velocity: Out[Array2],
) -> None:  # fmt: skip
    """Write points (n,3) in camera axes at their own times, and their velocities."""
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
def _whitened(sights: Projections, terms: Terms, n: int, by_point: Array, flow: Array) -> bool:
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


@entry
def squared_errors(sights: Projections, terms: Terms, out: Out[Array1]) -> None:
    """Write squared whitened errors (n,), px^2; infinite for keypoints without one."""
    by_point, flow = np.empty((2, 3)), np.empty((4, 2))
    for n in range(len(sights.first)):
        if _whitened(sights, terms, n, by_point, flow):
            e = sights.errors[n]
            a = flow[2, 0] * e[0] + flow[2, 1] * e[1]
            b = flow[3, 0] * e[0] + flow[3, 1] * e[1]
            out[n] = a * a + b * b
        else:
            out[n] = np.inf


@kernel
def _of_camera(
    sights: Projections, terms: Terms, n: int, r: int, flow: Array, by_point: Array, by_body: Array,
    row: Array,
) -> int:  # fmt: skip
    """Fill the derivatives of coordinate r by readout time, lens and mount; the column behind."""
    by_time, column = flow[2 + r, 0] * flow[0, 0] + flow[2 + r, 1] * flow[0, 1], LOCAL
    if terms.readout_free:
        row[column] = sights.tau[n] * by_time
        column += 1
    if terms.lens_free:
        for k in range(sights.by_lens.shape[2]):
            row[column + k] = (
                flow[2 + r, 0] * sights.by_lens[n, 0, k] + flow[2 + r, 1] * sights.by_lens[n, 1, k]
            )
        column += sights.by_lens.shape[2]
    if terms.mount_free:
        here = sights.local[n]
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            row[column + i] = here[a] * by_point[b] - here[b] * by_point[a]
            row[column + 3 + i] = -by_body[i]
        row[column + 6] = by_time
        column += EXTRINSICS
    return column


@kernel
def _of_landmark(
    sights: Projections, terms: Terms, n: int, column: int, by_landmark: Array, row: Array
) -> None:
    """Fill the derivatives by the landmark's place, and by its body's turn."""
    arm = sights.arms[n]
    for i in range(3 if terms.point_width > 0 else 0):
        a, b = (i + 1) % 3, (i + 2) % 3
        row[column + i] = by_landmark[i]
        if terms.point_width > 3:
            row[column + 3 + i] = arm[a] * by_landmark[b] - arm[b] * by_landmark[a]


@entry
def fill_rows(
    curve: Curve, sights: Projections, terms: Terms, values: Out[Array3], errors: Out[Array2]
) -> float:  # fmt: skip
    """Fill whitened, weighted derivatives (n,2,24 + k) and errors (n,2); returns the cost.

    Zeros where a keypoint does not count.
    """
    work, rotation, position = np.empty((8, 3, 3)), np.empty((3, 3)), np.empty(3)
    by_point, flow, error = np.empty((2, 3)), np.empty((4, 2)), np.empty(2)
    turn, g, p, basis = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    axes, full, cost = sights.axes, terms.limit / (3.0 * terms.variance), 0.0
    values[:] = 0.0
    errors[:] = 0.0
    for n in range(len(sights.first)):
        if not _whitened(sights, terms, n, by_point, flow):
            cost += full
            continue
        for i in range(2):
            error[i] = flow[2 + i, 0] * sights.errors[n, 0] + flow[2 + i, 1] * sights.errors[n, 1]
        rest = 1.0 - (error[0] * error[0] + error[1] * error[1]) / terms.limit
        if not rest > 0.0:
            cost += full
            continue
        cost += (1.0 - rest * rest * rest) * full
        scale, first = rest / np.sqrt(terms.variance), sights.first[n]
        pose(curve.rotations, curve.positions, curve.vectors, first, sights.u[n], work, rotation,
             position)  # fmt: skip
        for r in range(2):
            row, own = values[n, r], by_point[r]
            by_time = flow[2 + r, 0] * flow[0, 0] + flow[2 + r, 1] * flow[0, 1]
            # The derivative by the landmark, and the landmark, along the body's axes.
            for i in range(3):
                g[i], p[i] = 0.0, sights.centre[i]
                for j in range(3):
                    g[i] += axes[j, i] * own[j]
                    p[i] += axes[j, i] * sights.local[n, j]
            turn[0] = g[1] * p[2] - g[2] * p[1]
            turn[1] = g[2] * p[0] - g[0] * p[2]
            turn[2] = g[0] * p[1] - g[1] * p[0]
            pull_back(turn, curve.inverses, first, work, row)
            column = _of_camera(sights, terms, n, r, flow, own, g, row)
            cumulative(sights.u[n], 0, basis)
            for i in range(3):
                moved = rotation[i, 0] * g[0] + rotation[i, 1] * g[1] + rotation[i, 2] * g[2]
                turn[i] = moved
                for k in range(ORDER):
                    share = 1.0 if k == 0 else basis[k - 1]
                    if k < 3:
                        share -= basis[k]
                    row[CONTROL * k + 3 + i] = -share * moved
            _of_landmark(sights, terms, n, column, turn, row)
            if terms.delay_free:
                row[len(row) - 1] = by_time
            for k in range(len(row)):
                row[k] *= scale
            errors[n, r] = scale * error[r]
    return cost


@entry
def accumulate(
    values: Array3, errors: Array2, first: IntArray1, others: IntArray2, motion: int, kept: int,
    own: Out[Array2], cross: Out[Array2], corner: Out[Array2], slope: Out[Array1],
) -> None:  # fmt: skip
    """Add rows (n,r,k) to the lower triangle; unknowns from ``kept`` on are left out.

    ``own[j, i - j]`` is the entry of row i and column j of the motion.
    """
    numbers, rest = values.shape[1], others.shape[1]
    run = values.shape[2] - rest
    for n in range(len(values)):
        base = first[n]
        for q in range(numbers):
            row, error = values[n, q], errors[n, q]
            for b in range(run):
                x = row[b]
                if x == 0.0:
                    continue
                slope[base + b] += x * error
                line = own[base + b]
                for a in range(b, run):
                    line[a - b] += x * row[a]
                side = cross[base + b]
                for k in range(rest):
                    i = others[n, k]
                    if 0 <= i < kept:
                        side[i - motion] += x * row[run + k]
            for k in range(rest):
                i, x = others[n, k], row[run + k]
                if i < 0 or i >= kept or x == 0.0:
                    continue
                slope[i] += x * error
                for m in range(rest):
                    j = others[n, m]
                    if 0 <= j <= i:
                        corner[i - motion, j - motion] += x * row[run + m]
