# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Cumulative cubic B-splines on SO(3) x R^3: values, rates and their derivatives, compiled.

Between the knots ``i`` and ``i + 1`` four controls act; with ``u`` in [0, 1) and ``d_j =
log(R_{j-1}^T R_j)``

    R(u) = R_0 exp(l_1 d_1) exp(l_2 d_2) exp(l_3 d_3),    c(u) = sum_k b_k c_k

(Kim, Kim, Shin 1995; derivatives after Sommer et al., CVPR 2020). ``R`` is map_from_camera, ``c``
the camera's centre. A control changes by ``R exp(phi)``, ``c + delta``: 24 numbers for four
controls, in the order phi_0 delta_0 phi_1 ...
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, Array3, IntArray1, Out
from rs_localizer.core.so3 import coefficients, log
from rs_localizer.native import entry, inlined, kernel

ORDER = 4
"""Controls that act at one instant."""
CONTROL = 6
"""Parameters of a control."""
LOCAL = ORDER * CONTROL
"""Parameters that act at one instant."""


@kernel
def cumulative(u: float, order: int, out: Array) -> None:
    """Write the cumulative basis l_1, l_2, l_3 (or its derivative of this order by u)."""
    if order == 0:
        out[0] = (5.0 + u * (3.0 - u * (3.0 - u))) / 6.0
        out[1] = (1.0 + u * (3.0 + u * (3.0 - 2.0 * u))) / 6.0
        out[2] = u * u * u / 6.0
    elif order == 1:
        out[0] = 0.5 * (1.0 - u) * (1.0 - u)
        out[1] = 0.5 + u * (1.0 - u)
        out[2] = 0.5 * u * u
    else:
        out[0] = u - 1.0
        out[1] = 1.0 - 2.0 * u
        out[2] = u


@kernel
def product(a: Array, b: Array, out: Array) -> None:
    """Multiply (3,3) matrices: ``out = a b``."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@inlined
def turn(vector: Array, scale: float, rotation: Array, jacobian: Array) -> None:
    """Write ``exp(scale v)`` and ``scale`` times the right Jacobian of the exponential there."""
    x, y, z = scale * vector[0], scale * vector[1], scale * vector[2]
    first, second, third = coefficients(x * x + y * y + z * z)
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    rotation[0, 0] = 1.0 - second * (yy + zz)
    rotation[1, 1] = 1.0 - second * (xx + zz)
    rotation[2, 2] = 1.0 - second * (xx + yy)
    rotation[0, 1], rotation[1, 0] = second * xy - first * z, second * xy + first * z
    rotation[0, 2], rotation[2, 0] = second * xz + first * y, second * xz - first * y
    rotation[1, 2], rotation[2, 1] = second * yz - first * x, second * yz + first * x
    jacobian[0, 0] = scale * (1.0 - third * (yy + zz))
    jacobian[1, 1] = scale * (1.0 - third * (xx + zz))
    jacobian[2, 2] = scale * (1.0 - third * (xx + yy))
    jacobian[0, 1] = scale * (third * xy + second * z)
    jacobian[1, 0] = scale * (third * xy - second * z)
    jacobian[0, 2] = scale * (third * xz - second * y)
    jacobian[2, 0] = scale * (third * xz + second * y)
    jacobian[1, 2] = scale * (third * yz + second * x)
    jacobian[2, 1] = scale * (third * yz - second * x)


@inlined
def inverse_right_jacobian(v: Array, out: Array) -> None:
    """Write the inverse of the right Jacobian of the exponential at a rotation vector.

    Its transpose is that of the left one.
    """
    x, y, z = v[0], v[1], v[2]
    squared = x * x + y * y + z * z
    angle = np.sqrt(squared)
    if angle < 1e-3:
        second = 1.0 / 12.0 + squared / 720.0
    else:
        second = (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / squared
    out[0, 0] = 1.0 - second * (y * y + z * z)
    out[1, 1] = 1.0 - second * (x * x + z * z)
    out[2, 2] = 1.0 - second * (x * x + y * y)
    out[0, 1], out[1, 0] = second * x * y - 0.5 * z, second * x * y + 0.5 * z
    out[0, 2], out[2, 0] = second * x * z + 0.5 * y, second * x * z - 0.5 * y
    out[1, 2], out[2, 1] = second * y * z - 0.5 * x, second * y * z + 0.5 * x


@entry
def steps(rotations: Array3, vectors: Out[Array2], inverses: Out[Array3]) -> None:
    """Write rotation vectors (n,3) between controls and inverse right Jacobians (n,3,3).

    Row k leads from control k - 1 to k; row 0 stays as it is.
    """
    relative = np.empty((3, 3))
    for k in range(1, len(rotations)):
        before, now = rotations[k - 1], rotations[k]
        for i in range(3):
            for j in range(3):
                relative[i, j] = (
                    before[0, i] * now[0, j] + before[1, i] * now[1, j] + before[2, i] * now[2, j]
                )
        vectors[k] = log(relative)
        inverse_right_jacobian(vectors[k], inverses[k])


@kernel
def pose(
    rotations: Array, positions: Array, vectors: Array, first: int, u: float, work: Array,
    rotation: Array, position: Array,
) -> None:  # fmt: skip
    """Write the pose at ``u`` behind control ``first``; ``work`` (8,3,3) keeps intermediates.

    The basis of the positions is in ``work[7, 0:2]``.
    """
    basis = work[6, 0]
    cumulative(u, 0, basis)
    for k in range(3):
        turn(vectors[first + 1 + k], basis[k], work[k], work[3 + k])
    product(rotations[first], work[0], work[6])  # the basis has been used
    product(work[6], work[1], work[7])
    product(work[7], work[2], rotation)
    cumulative(u, 0, work[6, 0])
    for i in range(3):
        reached = positions[first, i]
        for k in range(3):
            reached += work[6, 0, k] * (positions[first + 1 + k, i] - positions[first + k, i])
        position[i] = reached


@kernel
def rates(
    positions: Array, vectors: Array, first: int, u: float, spacing: float, work: Array,
    rotation: Array, out: Array,
) -> None:  # fmt: skip
    """Write rows of ``out`` (4,3): body rate, velocity in the map, and their derivatives.

    ``work`` and ``rotation`` as :func:`pose` left them.
    """
    basis, change = work[6], work[7]
    cumulative(u, 1, basis[0])
    cumulative(u, 2, basis[1])
    for i in range(3):
        out[0, i] = 0.0
        out[2, i] = 0.0
        out[1, i] = 0.0
        out[3, i] = 0.0
    for k in range(3):
        d, back = vectors[first + 1 + k], work[k]
        for row in (0, 2):
            for i in range(3):
                change[row // 2, i] = (
                    back[0, i] * out[row, 0] + back[1, i] * out[row, 1] + back[2, i] * out[row, 2]
                )
        for i in range(3):
            out[0, i] = change[0, i] + basis[0, k] * d[i]
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            out[2, i] = (
                change[1, i]
                + basis[1, k] * d[i]
                + basis[0, k] * (out[0, a] * d[b] - out[0, b] * d[a])
            )
            moved = positions[first + 1 + k, i] - positions[first + k, i]
            out[1, i] += basis[0, k] * moved
            out[3, i] += basis[1, k] * moved
    for i in range(3):
        out[0, i] /= spacing
        out[1, i] /= spacing
        out[2, i] /= spacing * spacing
        out[3, i] /= spacing * spacing


@kernel
def pull_back(row: Array, inverses: Array, first: int, work: Array, out: Array) -> None:
    """Write the derivative by four controls' rotations of what changes by ``row`` (3,).

    Into ``out[0:3], out[6:9], ...``, of body-axes turns. ``work`` as :func:`pose` left it.
    """
    x, y, z = row[0], row[1], row[2]
    for k in range(LOCAL):
        if k % CONTROL < 3:
            out[k] = 0.0
    for k in range(2, -1, -1):
        jacobian, inverse, forward = work[3 + k], inverses[first + 1 + k], work[k]
        a = x * jacobian[0, 0] + y * jacobian[1, 0] + z * jacobian[2, 0]
        b = x * jacobian[0, 1] + y * jacobian[1, 1] + z * jacobian[2, 1]
        c = x * jacobian[0, 2] + y * jacobian[1, 2] + z * jacobian[2, 2]
        for i in range(3):
            out[CONTROL * (k + 1) + i] += a * inverse[0, i] + b * inverse[1, i] + c * inverse[2, i]
            out[CONTROL * k + i] -= a * inverse[i, 0] + b * inverse[i, 1] + c * inverse[i, 2]
        x, y, z = (
            forward[0, 0] * x + forward[0, 1] * y + forward[0, 2] * z,
            forward[1, 0] * x + forward[1, 1] * y + forward[1, 2] * z,
            forward[2, 0] * x + forward[2, 1] * y + forward[2, 2] * z,
        )
    out[0] += x
    out[1] += y
    out[2] += z


@entry
def states(
    rotations: Array3, positions: Out[Array2], vectors: Array2, first: IntArray1, u: Array1,
    spacing: float,
    out_rotations: Out[Array3], out_positions: Out[Array2], out_rates: Out[Array3],
) -> None:  # fmt: skip
    """Write poses and rates (as :func:`rates`) at many places."""
    work = np.empty((8, 3, 3))
    for k in range(len(first)):
        pose(
            rotations, positions, vectors, first[k], u[k], work, out_rotations[k], out_positions[k]
        )
        rates(positions, vectors, first[k], u[k], spacing, work, out_rotations[k], out_rates[k])


@entry
def jacobians(
    rotations: Array3, positions: Out[Array2], vectors: Array2, inverses: Array3, first: IntArray1,
    u: Array1,
    spacing: float, out: Out[Array3],
) -> None:  # fmt: skip
    """Write derivatives (m,12,24) of rotation, position, rate, velocity by the controls."""
    work, rotation, position = np.empty((8, 3, 3)), np.empty((3, 3)), np.empty(3)
    unit, weights, slopes = np.zeros(3), np.empty(3), np.empty(3)
    rate, carried = np.empty(3), np.empty(3)
    by_step, by_rate, before = np.empty((3, LOCAL)), np.empty((3, LOCAL)), np.empty((3, LOCAL))
    for m in range(len(first)):
        start = first[m]
        pose(rotations, positions, vectors, start, u[m], work, rotation, position)
        cumulative(u[m], 0, weights)
        cumulative(u[m], 1, slopes)
        for i in range(3):
            unit[:] = 0.0
            unit[i] = 1.0
            pull_back(unit, inverses, start, work, out[m, i])
            for k in range(ORDER):
                value = 1.0 if k == 0 else weights[k - 1]
                slope = 0.0 if k == 0 else slopes[k - 1]
                if k < 3:
                    value -= weights[k]
                    slope -= slopes[k]
                out[m, 3 + i, CONTROL * k + 3 + i] = value
                out[m, 9 + i, CONTROL * k + 3 + i] = slope / spacing
        rate[:] = 0.0
        by_rate[:] = 0.0
        for k in range(3):
            inverse, back, jacobian = inverses[start + 1 + k], work[k], work[3 + k]
            by_step[:] = 0.0
            for i in range(3):
                for j in range(3):
                    by_step[i, CONTROL * (k + 1) + j] = inverse[i, j]
                    by_step[i, CONTROL * k + j] = -inverse[j, i]
            before[:] = by_rate
            for i in range(3):
                carried[i] = back[0, i] * rate[0] + back[1, i] * rate[1] + back[2, i] * rate[2]
            for c in range(LOCAL):
                for i in range(3):
                    a, b = (i + 1) % 3, (i + 2) % 3
                    turned_a = turned_b = 0.0
                    total = slopes[k] * by_step[i, c]
                    for j in range(3):
                        turned_a += jacobian[a, j] * by_step[j, c]
                        turned_b += jacobian[b, j] * by_step[j, c]
                        total += back[j, i] * before[j, c]
                    by_rate[i, c] = total + carried[a] * turned_b - carried[b] * turned_a
            for i in range(3):
                rate[i] = carried[i] + slopes[k] * vectors[start + 1 + k, i]
        pace = 1.0 / spacing
        for i in range(3):
            for c in range(LOCAL):
                out[m, 6 + i, c] = pace * by_rate[i, c]
