# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Priors: of lens, mount, landmarks, times of images, and the whole's place."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.tools.adjust.spline import Spline
from rs_localizer.tools.adjust.system import Quadratic, Rows

# The whole may float so far while it is adjusted, by its size: loose enough to cost nothing.
_FLOAT = 1e-3


def known(offset: Array, information: Array, first: int) -> Quadratic:
    """Return the prior of numbers (k,) of the border, from ``first`` on, with these offsets."""
    slope = information @ offset
    columns = np.arange(first, first + len(offset))
    return Quadratic(columns, information, slope, float(offset @ slope))


def block_rows(offsets: Array, deviations: Array, first: int) -> Rows:
    """Return priors of blocks (b,w) of unknowns, from ``first`` on, with deviations (b,)."""
    count, width = offsets.shape
    values = np.eye(width) / deviations[:, None, None]
    errors = offsets / deviations[:, None]
    columns = first + np.arange(count * width).reshape(count, width)
    return Rows(values, np.zeros(count, np.int64), columns, errors, float(np.sum(errors**2)))


class Floating:
    """Seven directions in which map and motion move as a whole, held by the controls' start."""

    def __init__(self, start: Spline) -> None:
        self._start = start
        self._arms = start.positions - start.positions.mean(axis=0)
        self._squared = max(float(np.sum(self._arms**2)), 1e-12)
        size = np.sqrt(self._squared / len(self._arms))
        self._weights = 1.0 / (_FLOAT * np.array([size, size, size, 1.0, 1.0, 1.0, 1.0]))

    def rows(self, spline: Spline) -> Rows:
        """Return rows of mean shift, mean rotation and relative size."""
        count = len(spline.positions)
        shift = spline.positions - self._start.positions
        turned = spline.rotations @ np.swapaxes(self._start.rotations, 1, 2)
        turns = Rotation.from_matrix(turned).as_rotvec()
        size = np.sum(self._arms * shift) / self._squared
        errors = np.concatenate([shift.mean(axis=0), turns.mean(axis=0), [size]]) * self._weights
        by = np.zeros((count, 6, 7))
        by[:, 3:, :3] = np.eye(3) / count
        by[:, :3, 3:6] = np.swapaxes(spline.rotations, 1, 2) / count
        by[:, 3:, 6] = self._arms / self._squared
        values = np.ascontiguousarray((by.reshape(-1, 7) * self._weights).T)[None]
        none = np.zeros((1, 0), np.int64)
        return Rows(values, np.zeros(1, np.int64), none, errors[None], float(errors @ errors))
