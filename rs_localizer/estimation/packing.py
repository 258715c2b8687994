"""Points in lanes: how kernels of residuals want them."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.simd.tracing import LANES
from rs_localizer.estimation.view import POINT_SIZE


@kernel
def pack(points: Array, rays: Array, tau: Array, by_ray: Array) -> Array:
    """Points in lanes: (blocks, values, LANES) of points (n,3), rays (n,2), row times (n,) and
    derivatives of the pixel by the ray (n,2,2). The last block is filled up with weight zero.
    """
    count = len(points)
    blocks = (count + LANES - 1) // LANES
    data = np.empty((blocks, POINT_SIZE * LANES))
    for block in range(blocks):
        row = data[block]
        for lane in range(LANES):
            i = min(block * LANES + lane, count - 1)
            for k in range(3):
                row[k * LANES + lane] = points[i, k]
            row[3 * LANES + lane] = rays[i, 0]
            row[4 * LANES + lane] = rays[i, 1]
            row[5 * LANES + lane] = tau[i]
            for k in range(4):
                row[(6 + k) * LANES + lane] = by_ray[i, k // 2, k % 2]
            row[10 * LANES + lane] = 1.0 if block * LANES + lane < count else 0.0
    return data


@kernel
def thin(data: Array, chosen: IntArray) -> Array:
    """Only the chosen ones of the packed points, packed anew."""
    count = len(chosen)
    blocks = (count + LANES - 1) // LANES
    thinned = np.empty((blocks, POINT_SIZE * LANES))
    for place in range(blocks * LANES):
        i = chosen[min(place, count - 1)]
        for k in range(POINT_SIZE):
            value = data[i // LANES, k * LANES + i % LANES]
            if k == POINT_SIZE - 1 and place >= count:
                value = 0.0
            thinned[place // LANES, k * LANES + place % LANES] = value
    return thinned


@kernel
def weighted(data: Array, weights: Array | BoolArray) -> Array:
    """The packed points with these weights (n,): 1 or 0."""
    data = data.copy()
    for i in range(len(weights)):
        data[i // LANES, 10 * LANES + i % LANES] = weights[i]
    return data


def warm_up() -> None:
    """Compile what frames with many points come to."""
    thin(np.zeros((1, POINT_SIZE * LANES)), np.zeros(1, np.int64))
