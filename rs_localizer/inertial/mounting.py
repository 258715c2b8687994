"""Whether another rotation camera <- imu would make gyroscope and camera agree.

The rotation that carries the gyroscope's turns into the camera's (Wahba, "A least squares estimate
of satellite attitude", 1965; by the singular values of their correlation: Markley, 1988).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array

# Turns that a rotation explains, as a part of their sum of squares that it leaves.
_EXPLAINED = 0.1
# Turns about one axis alone say nothing of the others: second singular value to the first.
_LEAST_SPREAD = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """A rotation between the axes of the samples and those of the camera."""

    rotation: Array  # (3,3) camera_from_samples; the identity if TF is right
    left: float  # part of the squared turns that it does not explain

    @property
    def angle(self) -> float:
        """rad."""
        return float(np.linalg.norm(so3.log(self.rotation)))

    @property
    def explains(self) -> bool:
        return self.left < _EXPLAINED


def fit_mounting(shown: Array, seen: Array) -> Mounting | None:
    """The rotation that fits turns of the gyroscope (n,3) to those of the camera (n,3), both rad.

    None where they do not tell it.
    """
    left, sizes, right = np.linalg.svd(seen.T @ shown)
    if not sizes[1] > _LEAST_SPREAD * sizes[0]:
        return None
    sign = np.sign(np.linalg.det(left @ right))
    rotation = np.ascontiguousarray(left * [1.0, 1.0, sign] @ right)
    return Mounting(rotation, float(np.sum((seen - shown @ rotation.T) ** 2) / np.sum(seen**2)))
