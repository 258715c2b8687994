"""Products with a symmetric matrix whose eigenvalues are clipped.

For a few columns no eigenvectors are needed: Householder's reflections make the matrix tridiagonal,
implicit QL steps with Wilkinson's shift diagonal (Golub, Van Loan, "Matrix Computations", 8.3), and
the columns go through both, and back. That takes a third of the time of LAPACK's eigenvectors.
"""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.jit import inlined, kernel

_EPSILON = float(np.finfo(np.float64).eps)
# QL steps in all, for n eigenvalues: (least, for each); about two for each do.
_MOST_STEPS = (30, 4)


@inlined
def clipped_product(matrix: Array, limit: float, columns: Array) -> Array:
    """``V min(D, limit) V^T columns`` for a symmetric matrix ``V D V^T`` (n,n) and columns (n,m).

    Of the matrix the lower triangle counts.
    """
    reflected, product = matrix.copy(), columns.copy()
    diagonal, beside = _tridiagonal(reflected)
    count = len(diagonal)
    for k in range(count - 2):
        _reflect(reflected[k], k + 1, product)
    turns = _diagonalized(diagonal, beside, product)
    for i in range(count):
        value = min(diagonal[i], limit)
        for column in range(product.shape[1]):
            product[i, column] *= value
    for place, cosine, sine in turns[::-1]:
        _turn(product, int(place), cosine, -sine)
    for k in range(count - 3, -1, -1):
        _reflect(reflected[k], k + 1, product)
    return product


@inlined
def _tridiagonal(matrix: Array) -> tuple[Array, Array]:
    """Diagonal (n,) and what is beside it (n,), the last 0, of a matrix that is made tridiagonal.

    The lower triangle counts, and is used up; above the diagonal, row by row, it leaves the
    reflections' vectors, of length sqrt(2).
    """
    count = len(matrix)
    diagonal, beside, along = np.empty(count), np.zeros(count), np.empty(count)
    for k in range(count - 1):
        vector = matrix[k]
        diagonal[k] = vector[k]
        for i in range(k + 1, count):
            vector[i] = matrix[i, k]
        squared = 0.0
        for i in range(k + 1, count):
            squared += vector[i] * vector[i]
        first = vector[k + 1]
        beside[k] = -math.copysign(math.sqrt(squared), first)
        if k == count - 2:
            beside[k] = first
            break
        # The vector less its image, (first - beside, ...), is 2 squared - 2 first beside long.
        length = squared - first * beside[k]
        if not length > 0.0:
            vector[k + 1 :] = 0.0
            continue
        vector[k + 1] -= beside[k]
        scale = 1.0 / math.sqrt(length)
        for i in range(k + 1, count):
            vector[i] *= scale
            along[i] = 0.0
        for i in range(k + 1, count):  # the product with the rest, by its lower triangle
            row, own, total = matrix[i], vector[i], 0.0
            for j in range(k + 1, i):
                total += row[j] * vector[j]
            for j in range(k + 1, i):
                along[j] += row[j] * own
            along[i] += total + row[i] * own
        part = 0.0
        for i in range(k + 1, count):
            part += 0.5 * along[i] * vector[i]
        for i in range(k + 1, count):
            along[i] -= part * vector[i]
        for i in range(k + 1, count):
            row = matrix[i]
            for j in range(k + 1, i + 1):
                row[j] -= vector[i] * along[j] + along[i] * vector[j]
    diagonal[count - 1] = matrix[count - 1, count - 1]
    return diagonal, beside


@kernel
def _reflect(vector: Array, first: int, columns: Array) -> None:
    """Reflect columns (n,m) by a vector of length sqrt(2), from its place ``first`` on."""
    for column in range(columns.shape[1]):
        along = 0.0
        for i in range(first, len(vector)):
            along += vector[i] * columns[i, column]
        for i in range(first, len(vector)):
            columns[i, column] -= along * vector[i]


@inlined
def _diagonalized(diagonal: Array, beside: Array, columns: Array) -> Array:
    """Make a tridiagonal matrix diagonal, and turn columns (n,m) with it.

    Returns:
        Place, cosine and sine of each turn, in their order (k,3).
    """
    count = len(diagonal)
    left = _MOST_STEPS[0] + _MOST_STEPS[1] * count
    turns, done = np.empty((left * count, 3)), 0
    for low in range(count):
        while left > 0:
            left -= 1
            high = low
            while high < count - 1 and abs(beside[high]) > _EPSILON * (
                abs(diagonal[high]) + abs(diagonal[high + 1])
            ):
                high += 1
            if high == low:
                break
            half = (diagonal[low + 1] - diagonal[low]) / (2.0 * beside[low])
            root = math.copysign(math.sqrt(half * half + 1.0), half)
            bulge = diagonal[high] - diagonal[low] + beside[low] / (half + root)
            sine, cosine, moved = 1.0, 1.0, 0.0
            for i in range(high - 1, low - 1, -1):
                f, b = sine * beside[i], cosine * beside[i]
                length = math.sqrt(f * f + bulge * bulge)
                beside[i + 1] = length
                if length == 0.0:  # it has fallen into two
                    diagonal[i + 1] -= moved
                    break
                sine, cosine = f / length, bulge / length
                rest = diagonal[i + 1] - moved
                mixed = (diagonal[i] - rest) * sine + 2.0 * cosine * b
                moved = sine * mixed
                diagonal[i + 1] = rest + moved
                bulge = cosine * mixed - b
                _turn(columns, i, cosine, sine)
                turns[done, 0], turns[done, 1], turns[done, 2] = i, cosine, sine
                done += 1
            else:
                diagonal[low] -= moved
                beside[low] = bulge
            beside[high] = 0.0
    return turns[:done]


@kernel
def _turn(columns: Array, place: int, cosine: float, sine: float) -> None:
    """Turn two neighbouring rows of columns (n,m) into each other."""
    for column in range(columns.shape[1]):
        above, below = columns[place, column], columns[place + 1, column]
        columns[place, column] = cosine * above - sine * below
        columns[place + 1, column] = sine * above + cosine * below
