# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a film is stabilized: rows rotate otherwise than images.

A stabilizer turns each image as a whole, by an angle that changes smoothly. So the rotation ``r``
while rows are read differs from that between images, smoothly and about zero; what another shutter
adds is proportional to the motion, and what errors of map and lens add is small or stays. A camera
that vibrates near the rate of its images shows a smooth ``r``, too. But its rows are also bent: a
vibration of ``f`` Hz has a rate of ``2 pi f`` times its angle, and a curvature of as much again.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array2, Array3
from rs_localizer.estimation.robust import eliminate
from rs_localizer.native import entry, kernel

# Frames that are compared, and least number of them.
_LAST, _LEAST = 30, 8
# Rotations are smooth if the product of neighbours is so many deviations above that of independent
# ones (hands before right cameras: at most 4.5), and surely at twice as many, if also the logarithm
# of the odds against vibration is more than this.
_LIKELY = 5.0
# What another shutter adds is no other number than the mean below this part of the information.
_LEAST_TOLD = 1e-9


class RowRotation(NamedTuple):
    """The rotation over the rows of a frame, beside the motion between frames."""

    turned: Array  # (6,) rotation, rad per readout, and how it changes, rad per readout squared
    covariance: Array  # (6,6)
    by_shutter: Array  # (6,2) of it, if rows, or columns, take as long as is set


class RowRotations:
    """The rotations of the last frames beside those between images, compared."""

    def __init__(self) -> None:
        self._last: deque[RowRotation] = deque(maxlen=_LAST)
        self._smooth = self._bent = 0.0
        self.rate = 0.0
        """Rate (rad per readout, rms) at which images are turned as wholes, or vibrate."""
        self.most = 0.0
        """Rate (rad per readout, rms) of all rotations, as if neither shutter, map nor lens were
        wrong."""
        self.is_certain = False
        """Whether a stabilizer turned the images."""

    @property
    def are_enough(self) -> bool:
        """Whether vibration near the rate of the images would show."""
        return len(self._last) >= _LEAST

    def __len__(self) -> int:
        return len(self._last)

    @property
    def is_likely(self) -> bool:
        """Whether a stabilizer may have turned the images."""
        return self.is_certain or (self._smooth > _LIKELY and self._bent <= 0.0)

    @property
    def are_smooth(self) -> bool:
        """Whether a stabilizer has surely turned the images, unless the camera vibrates."""
        return self._smooth > 2.0 * _LIKELY

    @property
    def vibrates(self) -> bool:
        """Whether the camera rather vibrates near the rate of the images."""
        return self._smooth > _LIKELY and not self.is_likely

    def add(self, one: RowRotation, readouts: float) -> None:
        """Take the rotation of the next frame, ``readouts`` times readouts per interval later."""
        self._last.append(one)
        turned, covariances, by_shutter = map(np.array, zip(*self._last, strict=True))
        weights = np.linalg.inv(covariances[:, :3, :3]), np.linalg.inv(covariances[:, 3:, 3:])
        smooth, rate = _likeness(turned[:, :3].copy(), weights[0])
        self.most = rate if smooth > _LIKELY else 0.0
        if not self.are_enough:
            return
        self._smooth, self.rate, self._bent = _compared(
            turned, weights, covariances, by_shutter, readouts
        )
        is_new = self.are_smooth and self._bent < -_LIKELY
        self.is_certain = is_new or (self.is_certain and self._smooth > _LIKELY)


@entry
def _compared(
    turned: Array2, weights: tuple[Array3, Array3], covariances: Array3, by_shutter: Array3,
    readouts: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return likeness and rms of rotations (n,6) but for a shutter's, and odds of vibration."""
    count = len(turned)
    rates = _varying(turned[:, :3].copy(), weights[0], by_shutter)
    smooth, rate = _likeness(rates, weights[0])
    of_stabilizer = np.empty((count, 3))
    for i in range(count):
        before, after = max(i - 1, 0), min(i + 1, count - 1)
        of_stabilizer[i] = (rates[after] - rates[before]) * (readouts / (after - before))
    bends = _varying(turned[:, 3:] - of_stabilizer, weights[1], by_shutter[:, 3:].copy())
    vibrating = (math.pi * readouts * rate) ** 2 / 3.0
    return smooth, rate, _density(bends, covariances, vibrating) - _density(bends, covariances, 0.0)


@entry
def _likeness(values: Array2, weights: Array3) -> tuple[float, float]:
    """Return how alike neighbours of values (n,3) are, in deviations, and their rms.

    Independent errors of neighbours leave their product as it is. In the rms products count by
    what is known of them: where a motion starts or stops, little is.
    """
    pairs, square, total, before, known_before = 0.0, 0.0, 0.0, np.zeros(3), 0.0
    for i in range(len(values)):
        factor = weights[i].copy()
        known = math.sqrt(np.trace(factor))
        eliminate(factor, 3)
        whitened = np.triu(factor) @ values[i]
        pairs += np.sum(whitened * before)
        if i > 0:
            square += known * known_before * np.sum(values[i] * values[i - 1])
            total += known * known_before
        before, known_before = whitened, known
    square /= max(total, 1e-300)
    return pairs / math.sqrt(3.0 * len(values)), math.sqrt(max(square, 0.0))


@kernel
def _varying(values: Array, weights: Array, by_shutter: Array) -> Array:
    """Return values (n,3) without their mean, and without what another shutter adds."""
    normal, right, design = np.zeros((5, 5)), np.zeros(5), np.eye(3, 5)
    for i in range(len(values)):
        design[:, 3:] = by_shutter[i, :3]
        weighed = design.T @ weights[i]
        normal, right = normal + weighed @ design, right + weighed @ values[i]
    told, axes = np.linalg.eigh(normal)
    least = _LEAST_TOLD * told[4]
    found = axes @ ((right @ axes) * np.where(told > least, 1.0 / np.maximum(told, least), 0.0))
    rest: Array = values - found[:3]
    for i in range(len(values)):
        rest[i] -= by_shutter[i, :3].copy() @ found[3:]
    return rest


@kernel
def _density(values: Array, covariances: Array, more: float) -> float:
    """Return the logarithm of the density of values (n,3) but for a constant; each variance has
    ``more``.
    """
    total, equations = 0.0, np.empty((3, 4))
    for i in range(len(values)):
        equations[:, :3] = covariances[i, 3:, 3:] + more * np.eye(3)
        equations[:, 3] = values[i]
        eliminate(equations, 3)
        for k in range(3):
            total -= 0.5 * equations[k, 3] ** 2 + math.log(equations[k, k])
    return total
