# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Blocks of matrices, for kernels: Numba's slices ask each time whether shapes and memory fit."""

from __future__ import annotations

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.jit import kernel


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
