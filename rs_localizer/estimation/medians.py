"""Medians of some of many values, one of the two middle ones where their number is even."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.simd.jit import inlined, kernel


@kernel
def median_of(values: Array, chosen: BoolArray) -> float:
    """Median of the chosen ones of values (n,); NaN if there are none."""
    of = values[chosen]
    middle = len(of) // 2
    return float(np.partition(of, middle)[middle]) if len(of) > 0 else np.nan


@inlined
def median_point(points: Array, chosen: BoolArray) -> Array:
    """Median (3,) of each coordinate over some of the points (n,3); zero if there are none."""
    median = np.zeros(3)
    if np.any(chosen):
        for axis in range(3):
            median[axis] = median_of(points[:, axis], chosen)
    return median


@kernel
def median_depth(state: Array, points: Array, chosen: BoolArray) -> float:
    """How far before the camera of a state (24,) the median of some points (n,3) is; NaN: none."""
    depths = np.empty(len(points))
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        depths[i] = x * state[6] + y * state[7] + z * state[8] + state[11]
    return median_of(depths, chosen)
