# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rotation vectors and matrices; every function takes any number of leading dimensions."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Below this angle (rad) the first terms of the series are exact to rounding.
_SMALL = 1e-4


def cross_matrix(vector: Array) -> Array:
    """Matrices (...,3,3) of the cross products with vectors (...,3)."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def exponential(vector: Array) -> Array:
    """Rotations (...,3,3) by vectors (...,3), rad (Rodrigues)."""
    angle, cross = _angle(vector), cross_matrix(vector)
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    second = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


def logarithm(rotation: Array) -> Array:
    """Vectors (...,3) of rotations (...,3,3) by less than half a turn."""
    twice = rotation - np.swapaxes(rotation, -1, -2)
    skew = twice[..., [2, 0, 1], [1, 2, 0]]  # 2 sin(angle) axis
    sine = 0.5 * np.linalg.norm(skew, axis=-1)
    angle = np.arctan2(sine, 0.5 * (np.trace(rotation, axis1=-2, axis2=-1) - 1.0))
    small = sine < _SMALL
    factor = np.where(small, 0.5 + sine**2 / 12.0, 0.5 * angle / np.where(small, 1.0, sine))
    return np.asarray(factor[..., None] * skew)


def body_rate(vector: Array, rate: Array) -> Array:
    """Turn rates (...,3) in the body's axes of ``exponential(vector)`` while the vector changes
    by ``rate``, both (...,3): the right Jacobian times ``rate``.
    """
    angle, cross = _angle(vector), cross_matrix(vector)
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    jacobian = np.eye(3) - first * cross + second * (cross @ cross)
    return np.asarray((jacobian @ rate[..., None])[..., 0])


def _angle(vector: Array) -> Array:
    return np.asarray(np.linalg.norm(vector, axis=-1)[..., None, None])
