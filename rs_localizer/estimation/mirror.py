"""Planes show two poses: the one that is mirrored about the line of sight may fit as well.

From far away, or on a small marker, a plane that leans to the left and one that leans to the right
look alike but for perspective (Schweighofer, Pinz, "Robust pose estimation from a planar target",
PAMI 2006). A minimum that was found says nothing of the other one, so it is looked for.
"""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.lanes.jit import kernel
from rs_localizer.core.state import STATE_TRANSLATION, rotation_of

# Points whose depth relief is a smaller part than this of their narrower extent are a plane.
_PLANE = 0.1
# What leans by less (rad) has no mirrored pose of its own.
_LEAST_LEAN = 0.01


def mirrored(points: Array, inliers: BoolArray, state: Array) -> Array | None:
    """The state (24,) whose view of the plane of the points leans the other way.

    None if the points (n,3) that count are no plane, or face the camera.
    """
    return _leaning_less(points, inliers, state, 2.0)


def facing(points: Array, inliers: BoolArray, state: Array) -> Array | None:
    """The state (24,) half-way to the mirrored one, whose plane faces the camera; None as there."""
    return _leaning_less(points, inliers, state, 1.0)


def _leaning_less(points: Array, inliers: BoolArray, state: Array, leans: float) -> Array | None:
    """The state whose view of the plane leans by so many times its lean less."""
    plane, centre, axis_of_plane = _plane(points, inliers)
    if not plane:
        return None
    rotation, translation = rotation_of(state), state[STATE_TRANSLATION]
    seen = rotation @ centre + translation
    sight = seen / np.linalg.norm(seen)
    normal = rotation @ axis_of_plane
    axis = np.cross(sight, normal * np.sign(sight @ normal))
    lean = math.asin(min(float(np.linalg.norm(axis)), 1.0))
    if lean < _LEAST_LEAN:
        return None
    turn = so3.exp(-leans * lean * axis / np.linalg.norm(axis))
    turned = turn @ (translation - seen) + seen
    return np.concatenate([(turn @ rotation).ravel(), turned, state[STATE_TRANSLATION.stop :]])


@kernel
def _plane(points: Array, inliers: BoolArray) -> tuple[bool, Array, Array]:
    """Whether the points that count lie on a plane, their centre (3,) and its normal (3,)."""
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
