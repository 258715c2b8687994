# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks that move together: each free one by itself, or the corners of one rigid marker."""

from __future__ import annotations

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray

PLACE, BODY = 3, 6
"""Numbers of a free point, and of a body: its place, then its turn in the map's axes."""

_FLAT = 1e-6  # thickness of a plane by its size: rounding of single precision
# Standard deviations by half the size of a print. Paper curls by one part in a hundred (2 mm of an
# A4 sheet), in waves that are smaller the shorter they are; printers and screens stretch one
# direction by up to three parts in a thousand more than the other.
_BENDS = {2: 1e-2, 3: 5e-3, 4: 2.5e-3}  # by the degree of the polynomial
_STRETCH = 3e-3


def is_flat(points: Array) -> bool:
    """Return True if points (p,3) lie in one plane."""
    sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(sizes[2] < _FLAT * sizes[0])


def paper_covariance(points: Array, deviation: float) -> Array:
    """Return the covariance (3 p, 3 p) of the errors of points (p,3) on a flat print.

    Out of the plane low polynomials, which neither turn nor shift it, in the plane stretch and
    shear; and of each point by itself its ``deviation`` (m).
    """
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle)[2]
    flat = (points - middle) @ axes[:2].T
    half = 0.5 * float(np.ptp(flat, axis=0).max())
    x, y = (flat / half).T
    plane = np.column_stack([np.ones_like(x), x, y])
    modes = [
        _STRETCH * (np.outer(along, axes[0]) + np.outer(across, axes[1]))
        for along, across in ((x, -y), (y, x))
    ]
    for degree, size in _BENDS.items():
        for power in range(degree + 1):
            bend = x ** (degree - power) * y**power
            bend = bend - plane @ np.linalg.lstsq(plane, bend, rcond=None)[0]
            modes.append(size * np.outer(bend, axes[2]))
    root = half * np.reshape(modes, (len(modes), -1))
    return np.asarray(root.T @ root + deviation**2 * np.eye(root.shape[1]))


class Pieces:
    """The free parts of a map.

    Args:
        slots: (p,) number of the part that each landmark belongs to, from 0 on; -1: known.
        rigid: whether parts are bodies that turn, or single points.
    """

    def __init__(self, slots: IntArray, rigid: bool) -> None:
        self.slots, self.rigid, self.width = slots, rigid, BODY if rigid else PLACE
        self.count = int(slots.max(initial=-1)) + 1

    @property
    def columns(self) -> int:
        """How many numbers are free."""
        return self.width * self.count

    def centres(self, landmarks: Array) -> Array:
        """Return the middles (c,3) of the parts of landmarks (p,3)."""
        free = self.slots >= 0
        members = np.bincount(self.slots[free], minlength=self.count)
        sums = [np.bincount(self.slots[free], of, self.count) for of in landmarks[free].T]
        return np.column_stack(sums) / members[:, None]

    def arms(self, landmarks: Array) -> Array:
        """Return vectors (p,3) from the middle of its part to each landmark; zeros where known."""
        arms = np.zeros_like(landmarks)
        if self.rigid:
            free = self.slots >= 0
            arms[free] = landmarks[free] - self.centres(landmarks)[self.slots[free]]
        return arms

    def moved(self, landmarks: Array, step: Array) -> Array:
        """Return the landmarks (p,3) after a step (columns,)."""
        step, free = step.reshape(-1, self.width), self.slots >= 0
        moved, own = landmarks.copy(), self.slots[free]
        moved[free] += step[own, :PLACE]
        if self.rigid:
            turns, arms = so3.exp_many(step[:, PLACE:]), self.arms(landmarks)[free]
            moved[free] += np.einsum("nij,nj->ni", turns[own], arms) - arms
        return moved
