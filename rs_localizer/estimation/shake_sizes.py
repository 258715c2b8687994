"""Sizes of the polynomials of a shaking, and the step that goes with them.

By expectation maximization, with sizes that neighbouring degrees share.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.model_error import RIDGE
from rs_localizer.estimation.refine import LEAST_NOISE, half_inverse, inverted

_SIZE_ROUNDS = 8
_DOUBT = 2.0


@kernel
def sizes_and_step(
    products: Array, with_errors: Array, squared_errors: float, equations: float,
    information: Array, slope: Array, coefficients: Array, noise: float, least_size: float,
    sizes: Array,
) -> tuple[Array, Array, float]:  # fmt: skip
    """Step (m,) of motion and coefficients, covariance, and noise; ``sizes`` (k,) are updated.

    Args:
        products, with_errors, squared_errors: of the columns of motion and shaking.
        equations: two for each point.
        information, slope: of the motion's prior, (18,18) and (18,).
        coefficients: (k,3) of now.
        noise: px, a first estimate.
        least_size: rad, what is always possible.
    """
    count = len(with_errors)
    held = coefficients.ravel()
    matrix, right = np.empty((count, count)), np.empty(count)
    variances = np.empty(count)
    found = np.empty(len(sizes))
    for _ in range(_SIZE_ROUNDS - 1):
        _weighed(products, with_errors, information, slope, held, noise, sizes, matrix, right)
        half, scale, _ = half_inverse(matrix)
        step = _solved(half, scale, right)
        _variances(half, scale, variances)
        # Expected squares of the coefficients, and of the errors.
        for k in range(len(sizes)):
            total = 0.0
            for axis in range(3):
                place = PARAMETERS + 3 * k + axis
                total += (held[3 * k + axis] + step[place]) ** 2 + variances[place]
            found[k] = total / 3.0
        left, freedom = squared_errors, equations - count
        for i in range(count):
            along = 0.0
            for j in range(count):
                along += step[j] * products[i, j]
            left += step[i] * (along - 2.0 * with_errors[i])
        # What priors decide of the parameters uses up no freedom.
        freedom += _by_prior(half, scale, information)
        for k in range(PARAMETERS, count):
            freedom += variances[k] / sizes[(k - PARAMETERS) // 3]
        _share(found, least_size * least_size, sizes)
        noise = max(np.sqrt(max(left, 0.0) / max(freedom, 1.0)), LEAST_NOISE)
    # The sizes are estimates of few coefficients; the covariance allows for that.
    _weighed(products, with_errors, information, slope, held, noise, _DOUBT * sizes, matrix, right)
    covariance = inverted(matrix)
    step = np.empty(count)
    for i in range(count):
        along = 0.0
        for j in range(count):
            along += covariance[i, j] * right[j]
        step[i] = along
    return step, covariance, noise


@kernel
def _weighed(
    products: Array, with_errors: Array, information: Array, slope: Array, held: Array,
    noise: float, sizes: Array, matrix: Array, right: Array,
) -> None:  # fmt: skip
    """Normal equations of points, prior and sizes."""
    count = len(right)
    weight = 1.0 / (noise * noise)
    for i in range(count):
        for j in range(count):
            matrix[i, j] = weight * products[i, j]
        right[i] = weight * with_errors[i]
    for i in range(PARAMETERS):
        for j in range(PARAMETERS):
            matrix[i, j] += information[i, j]
        right[i] -= slope[i]
    for k in range(PARAMETERS, count):
        precision = 1.0 / sizes[(k - PARAMETERS) // 3]
        matrix[k, k] += precision
        right[k] -= precision * held[k - PARAMETERS]
    for i in range(count):
        matrix[i, i] *= RIDGE


@inlined
def _solved(half: Array, scale: Array, right: Array) -> Array:
    """The inverse (see :func:`half_inverse`) times a column (m,)."""
    count = len(right)
    solution = np.zeros(count)
    for i in range(count):
        row, total = half[i], 0.0
        for k in range(i + 1):
            total += row[k] * scale[k] * right[k]
        for k in range(i + 1):
            solution[k] += total * row[k]
    for i in range(count):
        solution[i] *= scale[i]
    return solution


@inlined
def _variances(half: Array, scale: Array, variances: Array) -> None:
    """The diagonal (m,) of the inverse."""
    variances[:] = 0.0
    for k in range(len(scale)):
        row = half[k]
        for i in range(k + 1):
            variances[i] += row[i] * row[i]
    for i in range(len(scale)):
        variances[i] *= scale[i] * scale[i]


@inlined
def _by_prior(half: Array, scale: Array, information: Array) -> float:
    """The trace of the first parameters' covariance times the information of their prior."""
    size = len(information)
    scaled = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            scaled[i, j] = information[i, j] * scale[i] * scale[j]
    total = 0.0
    for k in range(len(scale)):
        row = half[k]
        for i in range(min(k + 1, size)):
            along = 0.0
            for j in range(min(k + 1, size)):
                along += scaled[i, j] * row[j]
            total += along * row[i]
    return total


@inlined
def _share(found: Array, least: float, sizes: Array) -> None:
    """Mean squares of the neighbouring degrees, even and odd alike."""
    count = len(found)
    for k in range(count):
        total, weights = 0.0, 0.0
        for shift in range(-2, 3):
            if 0 <= k + shift < count:
                weight = 3.0 - abs(shift)
                total += weight * found[k + shift]
                weights += weight
        sizes[k] = total / weights + least
