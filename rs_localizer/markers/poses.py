# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses of prints in the map."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.core.arrays import Array

_ROTATION_TOLERANCE = 1e-3
# Two digits after the point are within this; what is farther from 1 was mistyped, or is no
# quaternion, and normalizing would make a wrong rotation of it.
_LENGTH_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Pose of a print: map_from_print.

    Raises:
        ValueError: for a mirrored or no rotation, or values that are not finite.
    """

    position: Array = field(default_factory=lambda: np.zeros(3))  # (3,) m, of its middle
    rotation: Array = field(default_factory=lambda: np.eye(3))  # (3,3)

    def __post_init__(self) -> None:
        position = finite(self.position, (3,), "position")
        rotation = finite(self.rotation, (3, 3), "rotation")
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if error > _ROTATION_TOLERANCE:
            raise ValueError(f"rotation is not a rotation matrix: its rows are {rotation.tolist()}")
        if np.linalg.det(rotation) < 0.0:
            raise ValueError(
                "the rotation mirrors (its determinant is -1): x is to the right, y up and z out "
                "of the print"
            )
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "rotation", rotation)

    def __call__(self, points: Array) -> Array:
        """Transform points (n,3) of the print to the map frame."""
        return np.asarray(points @ self.rotation.T + self.position)


def rotation_of_quaternion(quaternion: ArrayLike) -> Array:
    """Return the rotation matrix (3,3) of ``x y z w``, of unit length up to rounding.

    Raises:
        ValueError: for anything but four finite values of that length.
    """
    q = finite(quaternion, (4,), "quaternion (x, y, z, w)")
    length = float(np.linalg.norm(q))
    if abs(length - 1.0) > _LENGTH_TOLERANCE:
        raise ValueError(f"the quaternion (x y z w) must have the length 1, found {length:.4g}")
    x, y, z, w = q / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def finite(values: ArrayLike, shape: tuple[int, ...], name: str) -> Array:
    """Return the values as an array of this shape, or raise a ``ValueError`` that names them."""
    try:
        array = np.array(values, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be numbers, found {values!r}") from None
    if array.shape != shape:
        wanted = " x ".join(map(str, shape))
        raise ValueError(f"{name} must have {wanted} values, found the shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, found {array.tolist()}")
    return array
