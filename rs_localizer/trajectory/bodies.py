"""Landmarks that move together: each free one by itself, or the corners of one rigid marker."""

from __future__ import annotations

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray

PLACE, BODY = 3, 6
"""Numbers of a free point, and of a rigid body: its place, then its turn in the map's axes."""


class Pieces:
    """The free parts of a map.

    Args:
        slots: (p,) number of the part that each landmark belongs to, from 0 on; -1: known.
        rigid: whether parts are bodies that turn, or single points.
    """

    def __init__(self, slots: IntArray, rigid: bool) -> None:
        self.slots, self.rigid = slots, rigid
        self.width = BODY if rigid else PLACE
        self.count = int(slots.max(initial=-1)) + 1

    @property
    def columns(self) -> int:
        """How many numbers are free."""
        return self.width * self.count

    def centres(self, landmarks: Array) -> Array:
        """Middles (c,3) of the parts of landmarks (p,3)."""
        free = self.slots >= 0
        members = np.bincount(self.slots[free], minlength=self.count)
        sums = [np.bincount(self.slots[free], of, self.count) for of in landmarks[free].T]
        return np.column_stack(sums) / members[:, None]

    def arms(self, landmarks: Array) -> Array:
        """From the middle of its part to each landmark (p,3); zeros where it is known."""
        arms = np.zeros_like(landmarks)
        if self.rigid:
            free = self.slots >= 0
            arms[free] = landmarks[free] - self.centres(landmarks)[self.slots[free]]
        return arms

    def moved(self, landmarks: Array, step: Array) -> Array:
        """The landmarks (p,3) after a step (columns,)."""
        step, free = step.reshape(-1, self.width), self.slots >= 0
        moved, own = landmarks.copy(), self.slots[free]
        moved[free] += step[own, :PLACE]
        if self.rigid:
            turns, arms = so3.exp_many(step[:, PLACE:]), self.arms(landmarks)[free]
            moved[free] += np.einsum("nij,nj->ni", turns[own], arms) - arms
        return moved
