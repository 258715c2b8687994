# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Blocks of matrices, for kernels: Numba's slices ask each time whether shapes and memory fit."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.native import kernel


@kernel
def add_block(matrix: Array, row: int, column: int, factor: float, block: Array) -> None:
    """Add a multiple of a block (3,3) to a matrix, from a row and a column on."""
    for i in range(3):
        for j in range(3):
            matrix[row + i, column + j] += factor * block[i, j]


@kernel
def write(target: Array, source: Array) -> None:
    """Copy one contiguous array to another of the same shape."""
    to, values = target.ravel(), source.ravel()
    for i in range(len(to)):
        to[i] = values[i]


@kernel
def median(values: Array) -> float:
    """Return the median of values (n,), the larger of two middle ones; NaN of none.

    By Hoare's selection: NumPy's median, outer product and solve, with their indices and messages,
    were 47 of the 870 MB that the compiler takes for the default solver.
    """
    if len(values) == 0:
        return np.nan
    rest, first, last, middle = values.copy(), 0, len(values) - 1, len(values) // 2
    while first < last:
        pivot, i, j = rest[(first + last) // 2], first, last
        while i <= j:
            while rest[i] < pivot:
                i += 1
            while rest[j] > pivot:
                j -= 1
            if i <= j:
                rest[i], rest[j] = rest[j], rest[i]
                i, j = i + 1, j - 1
        if middle <= j:
            last = j
        elif middle >= i:
            first = i
        else:
            break
    return float(rest[middle])
