# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The kernel that renders textured planes, line by line."""

from __future__ import annotations

from typing import Any

import numpy as np

from rs_localizer.core.arrays import (
    ByteArray1,
    IntArray3,
    Out,
    SingleArray2,
    SingleArray4,
    SingleArray5,
)
from rs_localizer.native import entry, kernel

# Walls that meet in an edge overlap by this many texels, so that no ray slips between them.
_OVERLAP = np.float32(0.02)
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)


@entry
def render_lines(
    rays: SingleArray4, homographies: SingleArray5, texels: ByteArray1, levels: IntArray3,
    background: float, first: int, last: int, image: Out[SingleArray2],
) -> None:  # fmt: skip
    """Write the mean grey level of each pixel in the lines ``first`` to before ``last``.

    Every pixel averages its rays over all instants of its exposure. A ray takes the nearest
    plane that it meets within its picture, between the two reductions whose texels are nearest in
    size to the step between rays: the larger of the two steps, so that nothing aliases.

    Args:
        rays: (lines, pixels, 4, 2) float32, bearings of two by two rays in each pixel, the
            second beside the first and the third below it; a NaN meets nothing.
        homographies: (lines, instants, planes, 3, 3) float32, see TexturedPlane.homographies.
        texels, levels: see pyramids.
        background: float32, grey level of what meets no plane.
        image: (lines, pixels) float32, written.
    """
    pixels = rays.shape[1]
    instants, planes = homographies.shape[1], homographies.shape[2]
    # One instant takes all four rays. Several take two of a diagonal in turns: the mean of either
    # is the middle of the pixel, so that nothing is shifted.
    count = 4 if instants == 1 else 2
    dark = np.float32(background)
    deepest = np.float32(levels.shape[1] - 1)
    for line in range(first, last):
        for pixel in range(pixels):
            total = _ZERO
            known_plane, level, between = -1, 0, _ZERO
            for instant in range(instants):
                for j in range(count):
                    k = j if count == 4 else (3 * j if instant % 2 == 0 else 1 + j)
                    a, b = rays[line, pixel, k, 0], rays[line, pixel, k, 1]
                    nearest, plane, s, t = _ZERO, -1, _ZERO, _ZERO
                    for p in range(planes):
                        h = homographies[line, instant, p]
                        q = h[2, 0] * a + h[2, 1] * b + h[2, 2]
                        if q > nearest:
                            depth = _ONE / q
                            x = (h[0, 0] * a + h[0, 1] * b + h[0, 2]) * depth
                            y = (h[1, 0] * a + h[1, 1] * b + h[1, 2]) * depth
                            if (
                                x > -_OVERLAP
                                and y > -_OVERLAP
                                and x < levels[p, 0, 1] + _OVERLAP
                                and y < levels[p, 0, 2] + _OVERLAP
                            ):
                                nearest, plane, s, t = q, p, x, y
                    if plane < 0:
                        total += dark
                        continue
                    if plane != known_plane:
                        # The steps to the rays on the right and below, in texels.
                        h = homographies[line, instant, plane]
                        largest = _ZERO
                        for other in (1, 2):
                            da = rays[line, pixel, other, 0] - rays[line, pixel, 0, 0]
                            db = rays[line, pixel, other, 1] - rays[line, pixel, 0, 1]
                            dq = h[2, 0] * da + h[2, 1] * db
                            dx = (h[0, 0] * da + h[0, 1] * db - s * dq) / nearest
                            dy = (h[1, 0] * da + h[1, 1] * db - t * dq) / nearest
                            largest = max(largest, dx * dx + dy * dy)
                        fine = _ZERO
                        if largest > _ONE:
                            fine = min(_HALF * np.log2(largest), deepest)
                        level = int(fine)
                        between = fine - np.float32(level)
                        known_plane = plane
                    grey = _bilinear(texels, levels, plane, level, s, t)
                    if between > _ZERO:
                        coarse = _bilinear(
                            texels, levels, plane, min(level + 1, levels.shape[1] - 1), s, t
                        )
                        grey += between * (coarse - grey)
                    total += grey
            image[line, pixel] = total / np.float32(count * instants)


@kernel
def _bilinear(texels: Any, levels: Any, plane: int, level: int, s: Any, t: Any) -> Any:
    """Interpolate between the four texels around (s, t), which count in texels of level 0."""
    start, width, height = levels[plane, level, 0], levels[plane, level, 1], levels[plane, level, 2]
    scale = _ONE / np.float32(1 << level)
    x = min(max(s * scale - _HALF, _ZERO), np.float32(width - 1))
    y = min(max(t * scale - _HALF, _ZERO), np.float32(height - 1))
    column, row = int(x), int(y)
    right = min(column + 1, width - 1) - column
    upper = start + row * width + column
    lower = start + min(row + 1, height - 1) * width + column
    fx, fy = x - np.float32(column), y - np.float32(row)
    above = np.float32(texels[upper])
    above += fx * (np.float32(texels[upper + right]) - above)
    below = np.float32(texels[lower])
    below += fx * (np.float32(texels[lower + right]) - below)
    return above + fy * (below - above)
