"""How large the shaking and the field of a frame are, by the marginal likelihood of their sizes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.columns import Columns
from rs_localizer.estimation.refine import LEAST_NOISE

_LEAST_VARIANCE = LEAST_NOISE * LEAST_NOISE
# Where neither shaking nor field explains more than this (logarithm of the likelihood), there is
# nothing that both could explain.
_NOTHING_TO_SHARE = 1.0
_TURNS = 3  # in which size and noise settle


class Projected(NamedTuple):
    """A group of columns after the best motion was taken out of them."""

    products: Array  # (q,q) remaining, the lower triangle
    with_errors: Array  # (q,) remaining
    squared_errors: float  # remaining, px^2


@kernel
def project_out(products: Array, with_errors: Array, squared_errors: float, kept: int) -> Projected:
    """Take the columns before the last ``kept`` ones, with their prior, out of these."""
    size = len(products)
    base = size - kept
    # L^-1 times the columns to keep and the errors, for the Cholesky factor L of the others; scaled
    # to a unit diagonal, so that radians, metres and held parameters are comparable.
    scale, factor = np.empty(base), np.empty((base, base))
    half = np.empty((base, kept + 1))
    for i in range(base):
        scale[i] = 1.0 / np.sqrt(products[i, i])
        for j in range(kept):
            half[i, j] = products[i, base + j] * scale[i]
        half[i, kept] = with_errors[i] * scale[i]
        for j in range(i + 1):
            total = products[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            # A direction that nothing determines is left out.
            factor[i, j] = np.sqrt(max(total, 1e-15)) if i == j else total / factor[j, j]
        for k in range(i):
            for side in range(kept + 1):
                half[i, side] -= factor[i, k] * half[k, side]
        inverse = 1.0 / factor[i, i]
        for side in range(kept + 1):
            half[i, side] *= inverse
    left, along, left_over = np.empty((kept, kept)), np.empty(kept), squared_errors
    for i in range(kept):
        for j in range(kept):
            left[i, j] = products[base + i, base + j]
        along[i] = with_errors[base + i]
    for k in range(base):
        left_over -= half[k, kept] * half[k, kept]
        for i in range(kept):
            along[i] -= half[k, i] * half[k, kept]
            for j in range(i + 1):
                left[i, j] -= half[k, i] * half[k, j]
    return Projected(left, along, left_over)


@inlined
def log_determinant(matrix: Array) -> float:
    """Of a symmetric positive definite matrix, by Cholesky."""
    size = len(matrix)
    factor, total = np.empty((size, size)), 0.0
    for i in range(size):
        for j in range(i + 1):
            left = matrix[i, j]
            for k in range(j):
                left -= factor[i, k] * factor[j, k]
            if i == j:
                left = max(left, 1e-15 * matrix[i, i])  # what nothing determines
                total += np.log(left)
                factor[i, i] = np.sqrt(left)
            else:
                factor[i, j] = left / factor[j, j]
    return total


@kernel
def evidence_of_sizes(
    projected: Projected, sizes: Array, freedom: float, noise: float
) -> tuple[Array, Array]:
    """Logarithm of the marginal likelihood of sizes (k,), and the noise (k,) that goes with each.

    Args:
        projected: the group of columns.
        sizes: standard deviation of its coefficients.
        freedom: degrees of freedom of the errors.
        noise: a first estimate, px.
    """
    evidence, noises = np.empty(len(sizes)), np.empty(len(sizes))
    diagonal, beside, along = tridiagonal(projected.products, projected.with_errors)
    for index in range(len(sizes)):
        variance = noise * noise
        left, volume = projected.squared_errors, 0.0
        for turn in range(_TURNS):
            ratio = sizes[index] ** 2 / variance
            # Pivots of I + ratio * products, from the last one to the one that the errors meet.
            pivot, volume = 1.0, 0.0
            for i in range(len(diagonal) - 1, -1, -1):
                coupled = ratio * beside[i]
                pivot = 1.0 + max(ratio * diagonal[i] - coupled * coupled / pivot, 0.0)
                if turn == _TURNS - 1:
                    volume += np.log(pivot)
            left = projected.squared_errors - ratio * along * along / pivot
            variance = max(left / freedom, _LEAST_VARIANCE)
        evidence[index] = -0.5 * (freedom * np.log(variance) + volume)
        if left < freedom * _LEAST_VARIANCE:
            # The squares no longer are as many variances as there are degrees of freedom.
            evidence[index] += 0.5 * (freedom - left / _LEAST_VARIANCE)
        noises[index] = np.sqrt(variance)
    return evidence, noises


@inlined
def tridiagonal(matrix: Array, column: Array) -> tuple[Array, Array, float]:
    """A symmetric matrix (q,q) in the axes in which it is tridiagonal and a column lies along the
    first one: shifted by any multiple of the identity, it is solved and has its determinant in q
    steps. Of the matrix the lower triangle is read.

    Householder's reflections (Golub, Van Loan, "Matrix computations", 8.3) of the matrix that has
    the column as its border.

    Returns:
        diagonal (q,), what stands beside it behind each (q,), the last of which is 0, and the
        length of the column, or its negative.
    """
    size = len(column) + 1
    bordered = np.zeros((size, size))
    for i in range(size - 1):
        bordered[1 + i, 0] = column[i]
        for j in range(i + 1):
            bordered[1 + i, 1 + j] = matrix[i, j]
            bordered[1 + j, 1 + i] = matrix[i, j]
    diagonal, beside = np.empty(size), np.zeros(size)
    mirror, pulled = np.empty(size), np.empty(size)
    for k in range(size - 1):
        diagonal[k] = bordered[k, k]
        for i in range(k + 1, size):
            mirror[i] = bordered[i, k]
        square = 0.0
        for i in range(k + 1, size):
            square += mirror[i] * mirror[i]
        length = -np.sqrt(square) if mirror[k + 1] > 0.0 else np.sqrt(square)
        beside[k] = length
        mirror[k + 1] -= length
        # The reflection is I - mirror mirror^T / half.
        half = -length * mirror[k + 1]
        if not half > 0.0:
            continue
        across = 0.0
        for i in range(k + 1, size):
            total = 0.0
            for j in range(k + 1, size):
                total += bordered[i, j] * mirror[j]
            pulled[i] = total / half
            across += pulled[i] * mirror[i]
        for i in range(k + 1, size):
            pulled[i] -= 0.5 * across / half * mirror[i]
        for i in range(k + 1, size):
            for j in range(k + 1, size):
                bordered[i, j] -= mirror[i] * pulled[j] + pulled[i] * mirror[j]
    diagonal[size - 1] = bordered[size - 1, size - 1]
    return diagonal[1:], beside[1:], beside[0]


class Sizes(NamedTuple):
    """How large the shaking and the field of a frame are, root mean square of what is possible."""

    shake: float  # rad, of each coefficient
    field: float  # px
    noise: float  # px, beside them
    # Probability that there is none of it beyond what always may be.
    no_shake: float
    no_field: float
    # Logarithm of the marginal likelihood, but for the part of the motion.
    evidence: float
    # The same for each size that was tried, less that of the first.
    of_shake_sizes: Array
    of_field_sizes: Array


@kernel
def possible(evidence: Array, prior: Array, sizes: Array, noises: Array) -> Array:
    """Mean square size, mean noise, probability of the first size, and evidence of all (4,)."""
    highest = np.max(evidence)
    weights = prior * np.exp(evidence - highest)
    total = weights.sum()
    square, noise = 0.0, 0.0
    for k in range(len(evidence)):
        square += weights[k] / total * sizes[k] ** 2
        noise += weights[k] / total * noises[k]
    return np.array([square, noise, weights[0] / total, highest + np.log(total)])


@inlined
def sizes_of(
    columns: Columns, freedom: float, noise: float,
    shake_sizes: Array, shake_prior: Array, field_sizes: Array, field_prior: Array,
) -> Sizes:  # fmt: skip
    """Estimate both sizes of a frame at its best motion.

    Args:
        columns: of the frame, with shaking, field and prior.
        freedom: degrees of freedom of the errors beside the motion.
        noise: a first estimate, px.
        shake_sizes, field_sizes: those to try (rad, px); the first is what there always may be.
        shake_prior, field_prior: their probabilities.
    """
    shake = columns.shake
    size = len(columns.with_errors)
    order = np.empty(size, dtype=np.int64)
    both, right, cost = columns.products.copy(), columns.with_errors, columns.squared_errors
    first = PARAMETERS + shake

    if shake == 0:
        fields = project_out(both, right, cost, size - first)
        evidence, noises = evidence_of_sizes(fields, field_sizes, freedom, noise)
        of_field = possible(evidence, field_prior, field_sizes, noises)
        return Sizes(
            0.0, np.sqrt(of_field[0]), of_field[1], 1.0, of_field[2], of_field[3],
            np.zeros(len(shake_sizes)), evidence - evidence[0],
        )  # fmt: skip

    # Each on its own; then the one that explains more, and the other beside it.
    shaking = project_out(both[:first, :first], right[:first], cost, shake)
    shake_evidence, noises = evidence_of_sizes(shaking, shake_sizes, freedom, noise)
    of_shake = possible(shake_evidence, shake_prior, shake_sizes, noises)
    shake_gain = of_shake[3] - shake_evidence[0]
    for k in range(PARAMETERS):
        order[k] = k
    for k in range(size - first):
        order[PARAMETERS + k] = first + k
    for k in range(shake):
        order[PARAMETERS + size - first + k] = PARAMETERS + k
    turned, turned_right = both[order][:, order], right[order]
    last = size - shake
    fields = project_out(turned[:last, :last], turned_right[:last], cost, last - PARAMETERS)
    field_evidence, noises = evidence_of_sizes(fields, field_sizes, freedom, noise)
    of_field = possible(field_evidence, field_prior, field_sizes, noises)
    field_gain = of_field[3] - field_evidence[0]
    found = of_field if field_gain > shake_gain else of_shake
    total = found[3]
    if max(shake_gain, field_gain) < _NOTHING_TO_SHARE:
        pass
    elif field_gain < shake_gain:
        variance = of_shake[1] ** 2 / of_shake[0]
        for k in range(PARAMETERS, first):
            both[k, k] += variance
        fields = project_out(both, right, cost, size - first)
        field_evidence, noises = evidence_of_sizes(fields, field_sizes, freedom, of_shake[1])
        of_field = possible(field_evidence, field_prior, field_sizes, noises)
        found = of_field
        total += of_field[3] - field_evidence[0]
    else:
        variance = of_field[1] ** 2 / of_field[0]
        for k in range(PARAMETERS, last):
            turned[k, k] += variance
        shaking = project_out(turned, turned_right, cost, shake)
        shake_evidence, noises = evidence_of_sizes(shaking, shake_sizes, freedom, of_field[1])
        of_shake = possible(shake_evidence, shake_prior, shake_sizes, noises)
        found = of_shake
        total += of_shake[3] - shake_evidence[0]
    return Sizes(
        np.sqrt(of_shake[0]), np.sqrt(of_field[0]), found[1], of_shake[2], of_field[2], total,
        shake_evidence - shake_evidence[0], field_evidence - field_evidence[0],
    )  # fmt: skip
