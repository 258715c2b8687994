"""What a motion and a covariance must be to be a prior; each frame of a track has one."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.shutter import Motion, Numbers, numbers_of
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.state import MOTION_PARAMETERS, PARAMETERS

# Numbers whose squares are finite.
_MOST = 1e100
_OF_MOTION = (
    "rotation", "translation", "angular_velocity", "linear_velocity",
    "angular_acceleration", "linear_acceleration",
)  # fmt: skip
_ORTHONORMAL, _SYMMETRIC = 1e-6, 1e-6
# Least eigenvalue of a covariance scaled to a unit diagonal.
_LEAST_EIGENVALUE = 1e-12
_FAULTS = ("", "finite where its diagonal is", "symmetric", "positive definite")


def check_motion(motion: Motion) -> None:
    """Whether a motion may be one that is expected.

    Raises:
        ValueError: wrong shapes, values that are not finite, a rotation that is none.
    """
    for name in _OF_MOTION:
        shape = (3, 3) if name == "rotation" else (3,)
        if np.shape(getattr(motion, name)) != shape:
            raise ValueError(
                f"the prior motion's {name} must be of shape {shape}, "
                f"got {np.shape(getattr(motion, name))}"
            )
    numbers = numbers_of(motion)
    if not _is_finite(numbers):
        name = next(n for n in _OF_MOTION if not np.all(np.abs(getattr(motion, n)) < _MOST))
        raise ValueError(f"the prior motion's {name} is not finite: {getattr(motion, name)}")
    if not _is_rotation(numbers[0]):
        found = numbers[0].tolist()
        raise ValueError(f"the prior motion's rotation is not orthonormal: {found}")


def check_covariance(covariance: Array) -> None:
    """Whether an array may be a prior motion's covariance; infinite variances know nothing.

    Raises:
        ValueError: wrong shape, values that are not finite, no covariance.
    """
    if covariance.shape not in ((MOTION_PARAMETERS,) * 2, (PARAMETERS,) * 2):
        raise ValueError(f"covariance must be (12,12) or (18,18), got {covariance.shape}")
    fault = _FAULTS[_fault_of(np.ascontiguousarray(covariance))]
    if fault:
        raise ValueError(f"covariance must be {fault}")


@kernel
def _is_finite(numbers: Numbers) -> bool:
    rotation, translation, angular, linear, change, acceleration = numbers
    finite = True
    for i in range(3):
        for j in range(3):
            finite &= abs(rotation[i, j]) < _MOST
        finite &= abs(translation[i]) < _MOST and abs(angular[i]) < _MOST
        finite &= abs(linear[i]) < _MOST and abs(change[i]) < _MOST
        finite &= abs(acceleration[i]) < _MOST
    return finite


@kernel
def _is_rotation(matrix: Array) -> bool:
    off = 0.0
    for i in range(3):
        for j in range(3):
            total = -1.0 if i == j else 0.0
            for k in range(3):
                total += matrix[i, k] * matrix[j, k]
            off = max(off, abs(total))
    x, y, z = matrix[0], matrix[1], matrix[2]
    determinant = (
        (x[1] * y[2] - x[2] * y[1]) * z[0]
        + (x[2] * y[0] - x[0] * y[2]) * z[1]
        + (x[0] * y[1] - x[1] * y[0]) * z[2]
    )
    return off <= _ORTHONORMAL and determinant > 0.0


@kernel
def _fault_of(covariance: Array) -> int:
    """Place in ``_FAULTS`` of what is wrong with a covariance (k,k); 0: nothing."""
    size, known = len(covariance), 0
    places, scale = np.empty(size, np.int64), np.empty(size)
    for i in range(size):
        if not np.isinf(covariance[i, i]):
            places[known] = i
            known += 1
    for i in range(known):
        for j in range(known):
            if not np.isfinite(covariance[places[i], places[j]]):
                return 1
    for i in range(known):
        scale[i] = np.sqrt(abs(covariance[places[i], places[i]]))
    for i in range(known):
        for j in range(i):
            value, other = covariance[places[i], places[j]], covariance[places[j], places[i]]
            if not abs(value - other) <= _SYMMETRIC * scale[i] * scale[j]:
                return 2
    # Cholesky, scaled to a unit diagonal.
    factor = np.empty((known, known))
    for i in range(known):
        if not covariance[places[i], places[i]] > 0.0:
            return 3
        for j in range(i + 1):
            total = covariance[places[i], places[j]] / (scale[i] * scale[j])
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
            elif total > _LEAST_EIGENVALUE:
                factor[i, i] = np.sqrt(total - _LEAST_EIGENVALUE)
            else:
                return 3
    return 0
