# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""SIMD values in ordinary Numba code: loops where tracing would unroll too much.

The module ``tracing`` unrolls a small solver into straight-line code. Elimination and eigenvalues
of 20x20 matrices take tens of thousands of operations and need loops. Here Numba
gets one type whose values hold ``LANES`` doubles, one per sample, in one LLVM vector; kernels
load, combine and store such values as they would numbers.

Arrays are flat float64 arrays with ``LANES`` doubles per value, as :func:`tracing.traced` has them.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.tracing import LANES
from rs_localizer.native import COMPILES, kernel

if COMPILES:
    from rs_localizer.core.simd.vector_type import (
        absolute,
        load,
        root,
        store,
        uniform,
        where_less,
    )
else:  # kernels come compiled, and nobody calls these
    absolute = load = root = store = uniform = where_less = cast(Any, None)

__all__ = ["absolute", "lane_array", "load", "root", "store", "uniform", "where_less"]


@kernel
def lane_array(count: int) -> Array:
    """Return a new array of ``count`` vectors aligned to cache lines: no load touches two lines."""
    raw: Array = np.zeros((count + 1) * LANES)
    skip = (-raw.ctypes.data // 8) % LANES
    return raw[skip : skip + count * LANES]
