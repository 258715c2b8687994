# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Priors of a motion: accelerations at its controls, and the velocity of single images.

Accelerations have zero mean. With a memory, neighbouring ones are those of a first-order Markov
process (Singer, see :mod:`rs_localizer.tracking`): what counts is by how much one is not what the
one before lets expect.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from rs_localizer.core.arrays import IntArray
from rs_localizer.tools.adjust.spline import Layout, Spline
from rs_localizer.tools.adjust.spline_kernels import CONTROL, LOCAL
from rs_localizer.tools.adjust.system import Rows
from rs_localizer.tools.adjust.variables import Freedom


def _places(layout: Layout) -> tuple[IntArray, IntArray]:
    """Return controls with an acceleration (k,), and 1 for the first one of a stretch, else 0."""
    parts = [np.arange(first + 1, last - 1) for first, last in pairwise(layout.firsts.tolist())]
    begins = np.concatenate([np.arange(len(part)) == 0 for part in parts]).astype(np.int64)
    return np.concatenate(parts), begins


def acceleration_rows(spline: Spline, expected: Freedom) -> Rows:
    """Return six rows for each control with an acceleration: rotations, then positions."""
    spacing, fading = spline.layout.spacing, expected.fading
    at, begins = _places(spline.layout)
    vectors, inverses = spline.steps()
    first = at - 2 + begins
    values, errors = np.zeros((len(at), 6, LOCAL)), np.zeros((len(at), 6))
    memory = np.where(begins, 0.0, math.exp(-spacing / fading) if fading > 0.0 else 0.0)
    rows, axes = np.arange(len(at)), np.arange(3)
    for back in (0, 1):
        share = -memory if back else np.ones(len(at))
        used = np.flatnonzero(share)
        k, own, scale = at[used] - back, rows[used], share[used, None]
        before, after = inverses[k], inverses[k + 1]
        way = spline.positions[k - 1] - 2.0 * spline.positions[k] + spline.positions[k + 1]
        errors[used, :3] += scale * (vectors[k + 1] - vectors[k])
        errors[used, 3:] += scale * way
        by_turn = (before.swapaxes(1, 2), -before - after.swapaxes(1, 2), after)
        for place, by in enumerate(by_turn):
            column = CONTROL * (k - 1 + place - first[used])
            for i in range(3):
                for j in range(3):
                    values[own, i, column + j] += scale[:, 0] * by[:, i, j]
            weight = scale * (-2.0 if place == 1 else 1.0)
            values[own[:, None], 3 + axes, column[:, None] + 3 + axes] += weight
    usual = spacing**2 * np.sqrt(1.0 - memory**2)
    sizes = np.array([expected.angular_acceleration, expected.linear_acceleration])
    weights = np.repeat(1.0 / sizes, 3) / usual[:, None]
    errors *= weights
    values *= weights[:, :, None]
    none = np.zeros((len(at), 0), np.int64)
    return Rows(values, CONTROL * first, none, errors, float(np.sum(errors**2)))


def rest_rows(spline: Spline, angular: float, linear: float) -> Rows:
    """Return rows of zero-mean velocities (rad/s, m/s) in stretches of a single interval."""
    at = spline.layout.alone()
    vectors, inverses = spline.steps()
    values, errors = np.zeros((len(at), 6, 2 * CONTROL)), np.zeros((len(at), 6))
    errors[:, :3] = vectors[at + 1]
    errors[:, 3:] = spline.positions[at + 1] - spline.positions[at]
    values[:, :3, :3] = -inverses[at + 1].swapaxes(1, 2)
    values[:, :3, 6:9] = inverses[at + 1]
    values[:, 3:, 3:6], values[:, 3:, 9:] = -np.eye(3), np.eye(3)
    weights = 1.0 / (spline.layout.spacing * np.repeat([angular, linear], 3))
    errors *= weights
    none = np.zeros((len(at), 0), np.int64)
    return Rows(values * weights[:, None], CONTROL * at, none, errors, float(np.sum(errors**2)))
