# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rotations: exponential, logarithm and the Jacobian of the exponential.

Rotation vectors are in radians; matrices act on column vectors. The kernels may be called from
Python and from other kernels alike.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2
from rs_localizer.native import entry, kernel

# Below this angle the series of the coefficients are exact to double precision.
_SMALL_ANGLE = 1e-3


@kernel
def coefficients(angle_squared: float) -> tuple[float, float, float]:
    """Return ``sin(a)/a``, ``(1 - cos a)/a^2`` and ``(a - sin a)/a^3``, accurate at zero, too."""
    if angle_squared < _SMALL_ANGLE**2:
        return (
            1.0 - angle_squared / 6.0 * (1.0 - angle_squared / 20.0),
            0.5 - angle_squared / 24.0 * (1.0 - angle_squared / 30.0),
            1.0 / 6.0 - angle_squared / 120.0 * (1.0 - angle_squared / 42.0),
        )
    angle = np.sqrt(angle_squared)
    sine, half_sine = np.sin(angle), np.sin(0.5 * angle)
    return (
        sine / angle,
        2.0 * half_sine * half_sine / angle_squared,
        (angle - sine) / (angle_squared * angle),
    )


@entry
def exp(vector: Array1) -> Array:
    """Return the rotation matrix (3,3) of a rotation vector (3,) (Rodrigues' formula)."""
    x, y, z = vector[0], vector[1], vector[2]
    s, c, _ = coefficients(x * x + y * y + z * z)
    matrix = np.empty((3, 3))
    matrix[0, 0] = 1.0 - c * (y * y + z * z)
    matrix[0, 1] = c * x * y - s * z
    matrix[0, 2] = c * x * z + s * y
    matrix[1, 0] = c * x * y + s * z
    matrix[1, 1] = 1.0 - c * (x * x + z * z)
    matrix[1, 2] = c * y * z - s * x
    matrix[2, 0] = c * x * z - s * y
    matrix[2, 1] = c * y * z + s * x
    matrix[2, 2] = 1.0 - c * (x * x + y * y)
    return matrix


@entry
def quaternion(matrix: Array2) -> Array:
    """Return the unit quaternion (4,) ``x y z w`` with ``w >= 0`` of a rotation matrix (3,3)."""
    # Shepperd's choice of the largest component keeps the division well conditioned.
    q = np.empty(4)
    trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    largest = 3
    value = trace
    for i in range(3):
        if matrix[i, i] > value:
            largest, value = i, matrix[i, i]
    if largest == 3:
        q[0] = matrix[2, 1] - matrix[1, 2]
        q[1] = matrix[0, 2] - matrix[2, 0]
        q[2] = matrix[1, 0] - matrix[0, 1]
        q[3] = 1.0 + trace
    else:
        i = largest
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 + 2.0 * matrix[i, i] - trace
        q[j] = matrix[j, i] + matrix[i, j]
        q[k] = matrix[k, i] + matrix[i, k]
        q[3] = matrix[k, j] - matrix[j, k]
    norm = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[3] < 0.0:
        norm = -norm
    scale = 1.0 / norm
    for i in range(4):
        q[i] *= scale
    return q


@entry
def log(matrix: Array2) -> Array:
    """Return the rotation vector (3,), of angle 0 to pi, of a rotation matrix (3,3)."""
    q = quaternion(matrix)
    sine_squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2]
    sine = np.sqrt(sine_squared)
    # Series of 2 atan2(s, w)/s: the direct form is 0/0 at the identity.
    scale = 2.0 + sine_squared / 3.0 if sine < 1e-5 else 2.0 * np.arctan2(sine, q[3]) / sine
    vector = np.empty(3)
    for i in range(3):
        vector[i] = scale * q[i]
    return vector


def hat(vector: Array) -> Array:
    """Return skew matrices (..., 3, 3) with ``hat(v) @ x == cross(v, x)`` of vectors (..., 3)."""
    vector = np.ascontiguousarray(vector, float)
    if vector.ndim == 1:
        return hat_of(vector)
    matrix = np.zeros((*vector.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -vector[..., 2], vector[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = vector[..., 2], -vector[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -vector[..., 1], vector[..., 0]
    return matrix


def right_jacobian(vector: Array) -> Array:
    """Return the right Jacobian (3,3) of the exponential at a rotation vector (3,).

    ``exp(a + d) = exp(a) exp(right_jacobian(a) d)`` to first order.
    """
    return right_jacobian_of(np.ascontiguousarray(vector, float))


@entry
def hat_of(vector: Array1) -> Array:
    """Return the skew matrix (3,3) of a vector (3,); kernels call it."""
    matrix = np.zeros((3, 3))
    matrix[0, 1], matrix[0, 2] = -vector[2], vector[1]
    matrix[1, 0], matrix[1, 2] = vector[2], -vector[0]
    matrix[2, 0], matrix[2, 1] = -vector[1], vector[0]
    return matrix


@entry
def right_jacobian_of(vector: Array1) -> Array:
    """Return :func:`right_jacobian` of a rotation vector (3,); kernels call it."""
    x, y, z = vector[0], vector[1], vector[2]
    _, second, third = coefficients(x * x + y * y + z * z)
    jacobian = np.empty((3, 3))
    jacobian[0, 0] = 1.0 - third * (y * y + z * z)
    jacobian[1, 1] = 1.0 - third * (x * x + z * z)
    jacobian[2, 2] = 1.0 - third * (x * x + y * y)
    jacobian[0, 1], jacobian[1, 0] = third * x * y + second * z, third * x * y - second * z
    jacobian[0, 2], jacobian[2, 0] = third * x * z - second * y, third * x * z + second * y
    jacobian[1, 2], jacobian[2, 1] = third * y * z + second * x, third * y * z - second * x
    return jacobian


def exp_many(vectors: Array) -> Array:
    """Return the rotation matrices (n,3,3) of rotation vectors (n,3)."""
    vectors = np.ascontiguousarray(vectors, dtype=np.float64)
    return _exp_many(vectors)


@entry
def _exp_many(vectors: Array2) -> Array:
    matrices = np.empty((len(vectors), 3, 3))
    for i in range(len(vectors)):
        matrices[i] = exp(vectors[i])
    return matrices
