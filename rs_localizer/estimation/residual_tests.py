# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Tests of what a model leaves of a frame: what would explain it, and what refuses it."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.simd.jit import kernel
from rs_localizer.estimation.refine import LEAST_NOISE

# Points nearer than this part of the image that the points fill are neighbours in it.
_FAR_APART = 0.15
# No frame says more than this to the next ones (standard normal).
_CLIPPED = 6.0


@kernel
def neighbours_agree(errors: Array, tau: Array, rays: Array, inliers: BoolArray) -> float:
    """How much the errors of points in neighbouring rows agree: standard normal if they do not.

    Neighbours in the image do not count: corners of one marker share errors whatever the camera
    does.
    """
    order = np.argsort(tau)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    squared, count = 0.0, 0
    for i in order:
        if inliers[i]:
            squared += errors[i, 0] ** 2 + errors[i, 1] ** 2
            count += 1
            for k in range(2):
                low[k], high[k] = min(low[k], rays[i, k]), max(high[k], rays[i, k])
    if count < 2 or not squared > 0.0:
        return 0.0
    far = _FAR_APART * max(high[0] - low[0], high[1] - low[1])
    agreement, pairs = 0.0, 0
    previous = -1
    for i in order:
        if not inliers[i]:
            continue
        if previous >= 0:
            x, y = rays[i, 0] - rays[previous, 0], rays[i, 1] - rays[previous, 1]
            if x * x + y * y > far * far:
                pairs += 1
                agreement += errors[previous, 0] * errors[i, 0] + errors[previous, 1] * errors[i, 1]
        previous = i
    # Each of the two products of a pair has the square of the mean square as its variance.
    variance = max(0.5 * squared / count, LEAST_NOISE * LEAST_NOISE)
    normalized: float = agreement / (variance * np.sqrt(2.0 * max(pairs, 1)))
    return normalized


def standard_scores(explained: Array, own: Array, freedom: float) -> Array:
    """How much more than chance columns explain (15,), standard normal where there is nothing.

    An F test, because the noise is of the same errors (Rao 1948), by Paulson's approximation
    (1942).

    Args:
        explained: (15,) squares in noise variances.
        own: (15,) how many columns explain them that the motion does not mimic.
        freedom: of the errors.
    """
    rest = freedom - own
    enough = rest >= 1.0
    rest = np.maximum(rest, 1.0)
    left = np.maximum(freedom - explained, 1e-3 * max(freedom, 1.0))
    ratio = explained / own * rest / left
    cube, a, b = np.cbrt(ratio), 2.0 / (9.0 * own), 2.0 / (9.0 * rest)
    standard = ((1.0 - b) * cube - (1.0 - a)) / np.sqrt(b * cube**2 + a)
    return np.where(enough, np.clip(standard, -_CLIPPED, _CLIPPED), -_CLIPPED)
