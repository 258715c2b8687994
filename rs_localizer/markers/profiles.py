# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Where along its normal an edge from black to white lies, sharp or smeared by motion.

A pixel's light is its integral, and motion smears an edge evenly to both sides of where it is in
the middle of the exposure: the centroid of the slope stays where it was. It is right as long as
the profile shows the whole rise. Blurred by more than a cell, the black border never gets black:
what lies inside cuts the foot of the rise off. Around half way between black and white, as the
rest of the marker shows them, it is still the edge's own.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.jit import inlined, kernel

# px between the samples of a profile; more for one that reaches farther than so many steps.
_STEP, _MOST_STEPS = 0.5, 7
_LEAST_RISE = 10.0  # gray levels from black to white
SEEN, VARIANCE, BLACK, WHITE, CUT = range(5)
"""What :func:`edge_points` tells of the rises: how many, and of those the means of the variance
(px^2), of the levels at foot and top, and the share that goes on beyond its profile."""


@kernel
def edge_points(
    image: NDArray[np.uint8],
    a: Array,
    b: Array,
    half: float,
    levels: tuple[float, float],
    s: Array,
    e: Array,
) -> Array:
    """Find points of the edge near the side from a to b.

    Args:
        image: (h,w) gray.
        a, b: (2,) px; white is to the left of the way from a to b as an image shows it.
        half: px that the profiles reach to either side.
        levels: half way between black and white, and how far around it rises are the edge's
            own; NaN: all the way.
        s: (n,) places along the side, from -1 in a to 1 in b.
        e: (n,) out: px from the side to the white; NaN: no edge.

    Returns:
        (5,) the rises, see :data:`SEEN`.
    """
    dx, dy = b[0] - a[0], b[1] - a[1]
    length = math.sqrt(dx * dx + dy * dy)
    nx, ny = dy / length, -dx / length  # outward: corners go clockwise, and y is down
    step = max(_STEP, half / _MOST_STEPS)
    profile, rises = np.empty(2 * math.ceil(half / step) + 1), np.zeros(5)
    reach = step * (len(profile) // 2)
    for k in range(len(s)):
        share = 0.5 + 0.5 * s[k]
        x, y = a[0] + share * dx, a[1] + share * dy
        e[k] = math.nan
        if _sample(image, x - reach * nx, y - reach * ny, step * nx, step * ny, profile):
            e[k] = step * _edge(profile, levels, step, rises) - reach
    if rises[SEEN] > 0.0:
        seen = rises[SEEN]
        for i in range(1, len(rises)):
            rises[i] /= seen
    return rises


@inlined
def _sample(
    image: NDArray[np.uint8], x: float, y: float, dx: float, dy: float, profile: Array
) -> bool:
    """Gray levels from a point on; false where they leave the image."""
    last = len(profile) - 1
    if _outside(image, x, y) or _outside(image, x + last * dx, y + last * dy):
        return False
    for k in range(len(profile)):
        u, v = x + k * dx, y + k * dy
        column, row = int(u), int(v)
        fx, fy = u - column, v - row
        above = (1.0 - fx) * image[row, column] + fx * image[row, column + 1]
        below = (1.0 - fx) * image[row + 1, column] + fx * image[row + 1, column + 1]
        profile[k] = (1.0 - fy) * above + fy * below
    return True


@kernel
def _outside(image: NDArray[np.uint8], x: float, y: float) -> bool:
    height, width = image.shape
    return not (0.0 <= x < width - 1.0 and 0.0 <= y < height - 1.0)


@inlined
def _edge(profile: Array, levels: tuple[float, float], step: float, rises: Array) -> float:
    """The place (samples) of the steepest unbroken rise, which is added to the rises; NaN: none.

    Any weight but the slope itself draws an edge along a row of pixels to their middle or rim, by
    up to 0.15 px.
    """
    steepest, at = 0.0, 0
    for k in range(1, len(profile)):
        if profile[k] - profile[k - 1] > steepest:
            steepest, at = profile[k] - profile[k - 1], k
    first, last = at, at
    while first > 0 and profile[first - 1] < profile[first]:
        first -= 1
    while last + 1 < len(profile) and profile[last + 1] > profile[last]:
        last += 1
    rise = profile[last] - profile[first]
    if rise < _LEAST_RISE:
        return math.nan
    moment, square = 0.0, 0.0
    for k in range(first + 1, last + 1):
        share, offset = (profile[k] - profile[k - 1]) / rise, k - 0.5 - at
        moment += share * offset
        square += share * offset * offset
    rises[SEEN] += 1.0
    rises[VARIANCE] += step * step * (square - moment * moment)
    rises[BLACK] += profile[first]
    rises[WHITE] += profile[last]
    rises[CUT] += first == 0 or last == len(profile) - 1
    middle, around = levels
    around = min(around, middle - profile[first], profile[last] - middle)
    if not around > 0.0:
        return float(at + moment)
    moment = 0.0
    for k in range(first + 1, last + 1):
        low, high = max(profile[k - 1], middle - around), min(profile[k], middle + around)
        if low < high:
            share = (0.5 * (low + high) - profile[k - 1]) / (profile[k] - profile[k - 1])
            moment += (high - low) * (k - 1 + share)
    return float(moment / (2.0 * around))
