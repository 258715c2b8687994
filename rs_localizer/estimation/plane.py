# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Points on a plane: a test, its other views, and the rotation that is known worst.

From far away, or on a small marker, planes that lean to the left and to the right look alike up to
perspective. (Schweighofer, Pinz, "Robust pose estimation from a planar target", PAMI 2006.)
"""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, Array1, Array2, BoolArray1
from rs_localizer.native import entry

# Points whose depth relief is a smaller part than this of their narrower extent are a plane.
_PLANE = 0.1
# A plane that leans by less (rad) faces the camera.
_LEAST_LEAN = 0.01


@entry
def leaning_less(
    points: Array2, inliers: BoolArray1, state: Array1, leans: float
) -> tuple[bool, Array]:
    """Return True and the state (24,) with the plane's lean reduced so many times.

    Twice its lean less it is mirrored, once it faces the camera. False if the points (n,3) that
    count are no plane, or face the camera.
    """
    plane, centre, axis_of_plane = plane_of(points, inliers)
    if not plane:
        return False, state
    seen, normal = state[9:12].copy(), np.zeros(3)
    for i in range(3):
        for k in range(3):
            seen[i] += state[3 * i + k] * centre[k]
            normal[i] += state[3 * i + k] * axis_of_plane[k]
    sight = seen / np.sqrt(np.sum(seen * seen))
    normal *= np.sign(np.sum(sight * normal))
    axis = np.empty(3)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        axis[i] = sight[j] * normal[k] - sight[k] * normal[j]
    length = np.sqrt(np.sum(axis * axis))
    lean = np.arcsin(min(length, 1.0))
    if lean < _LEAST_LEAN:
        return False, state
    flip = so3.exp(-leans * lean / length * axis)
    other = state.copy()
    for i in range(3):
        other[9 + i] = seen[i]
        for k in range(3):
            other[9 + i] += flip[i, k] * (state[9 + k] - seen[k])
            other[3 * i + k] = 0.0
            for m in range(3):
                other[3 * i + k] += flip[i, m] * state[3 * m + k]
    return True, other


@entry
def plane_of(points: Array2, inliers: BoolArray1) -> tuple[bool, Array, Array]:
    """Return True if the counted points lie on a plane, its centre (3,) and normal (3,)."""
    centre, spread, count = np.zeros(3), np.zeros((3, 3)), 0
    for i in range(len(points)):
        if inliers[i]:
            count += 1
            for k in range(3):
                centre[k] += points[i, k]
    if count == 0:
        return False, centre, centre
    centre /= count
    for i in range(len(points)):
        if inliers[i]:
            for j in range(3):
                for k in range(j + 1):
                    spread[j, k] += (points[i, j] - centre[j]) * (points[i, k] - centre[k])
    for j in range(3):
        for k in range(j):
            spread[k, j] = spread[j, k]
    extents, axes = np.linalg.eigh(spread)
    return extents[0] < _PLANE**2 * extents[1], centre, axes[:, 0].copy()


@entry
def longest_axis(covariance: Array2) -> float:
    """Return the deviation (rad) of the rotation about the axis that is known worst."""
    return math.sqrt(np.linalg.eigvalsh(covariance[:3, :3].copy())[-1])
