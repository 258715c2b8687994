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

from rs_localizer.core.arrays import Array

# Frames that are compared, and least number of them.
_LAST, _LEAST = 30, 8
# Rotations are smooth if the product of neighbours is so many deviations above that of independent
# ones (hands before right cameras: at most 4.5), and surely at twice as many, if also the logarithm
# of the odds against vibration is more than this.
_LIKELY = 5.0


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
    def vibrates(self) -> bool:
        """Whether the camera rather vibrates near the rate of the images."""
        return self._smooth > _LIKELY and not self.is_likely

    def add(self, one: RowRotation, readouts: float) -> None:
        """Take the rotation of the next frame, ``readouts`` times readouts per interval later."""
        self._last.append(one)
        turned, covariances, by_shutter = map(np.array, zip(*self._last, strict=True))
        weights = np.linalg.inv(covariances[:, :3, :3])
        smooth, rate = _likeness(turned[:, :3], weights)
        self.most = rate if smooth > _LIKELY else 0.0
        if not self.are_enough:
            return
        rates = _varying(turned[:, :3], weights, by_shutter[:, :3])
        self._smooth, self.rate = _likeness(rates, weights)
        of_stabilizer = np.gradient(rates, axis=0) * readouts
        weights = np.linalg.inv(covariances[:, 3:, 3:])
        bends = _varying(turned[:, 3:] - of_stabilizer, weights, by_shutter[:, 3:])
        vibrating = (math.pi * readouts * self.rate) ** 2 / 3.0 * np.eye(3)
        some, none = (_fit(bends, covariances[:, 3:, 3:] + more) for more in (vibrating, 0.0))
        self._bent = some - none
        is_new = self._smooth > 2.0 * _LIKELY and self._bent < -_LIKELY
        self.is_certain = is_new or (self.is_certain and self._smooth > _LIKELY)


def _likeness(values: Array, weights: Array) -> tuple[float, float]:
    """Return how alike neighbours of values (n,3) are, in deviations, and their rms.

    Independent errors of neighbours leave their product as it is.
    """
    whitened = np.einsum("nij,ni->nj", np.linalg.cholesky(weights), values)
    pairs = float(np.sum(whitened[1:] * whitened[:-1])) / math.sqrt(3.0 * len(values))
    square = float(np.sum(values[1:] * values[:-1])) / max(len(values) - 1, 1)
    return pairs, math.sqrt(max(square, 0.0))


def _varying(values: Array, weights: Array, by_shutter: Array) -> Array:
    """Return values (n,3) without their mean, and without what another shutter adds."""
    columns = np.tile(np.eye(3), (len(values), 1, 1))
    design = np.concatenate([columns, by_shutter], axis=2)
    weighed = np.swapaxes(design, 1, 2) @ weights
    known = (weighed @ design).sum(axis=0), (weighed @ values[:, :, None]).sum(axis=0)
    rest: Array = values - (design @ np.linalg.lstsq(*known, rcond=1e-9)[0])[:, :, 0]
    return rest


def _fit(values: Array, covariances: Array) -> float:
    """Return the logarithm of the density of values (n,3), but for a constant."""
    squares = np.sum(values * np.linalg.solve(covariances, values[:, :, None])[:, :, 0])
    return -0.5 * float(squares + np.linalg.slogdet(covariances)[1].sum())
