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
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array

# Frames that are compared, and least number of them.
_LAST, _LEAST = 30, 8
# Rotations are smooth if the product of neighbours is so many deviations above that of independent
# ones (hands before right cameras: at most 4.5), and surely at twice as many, if also the logarithm
# of the odds against vibration is more than this.
_LIKELY = 5.0
# What another shutter adds is no other number than the mean below this part of the information.
_LEAST_TOLD = 1e-9


class RowRotation(NamedTuple):
    """The rotation over the rows of a frame, beside the motion between frames, and its change."""

    turned: Array  # (2,3) rad per readout, and rad per readout squared
    covariances: Array  # (2,3,3)
    by_shutter: Array  # (2,3,2) of it, if rows, or columns, take as long as is set


class _Whitened(NamedTuple):
    """Rotations of n frames and their changes, and what a mean and another shutter make them."""

    turned: Array  # (n,2,3)
    design: Array  # (n,2,3,5) derivatives by the mean, and by what another shutter adds
    whiten: Array  # (n,2,3,3)
    rows: Array  # (n,2,3,5) the whitened design
    variances: Array  # (n,2,3)

    def and_of(self, one: RowRotation) -> _Whitened:
        """Return the last ones, and one more."""
        design = np.concatenate([np.broadcast_to(np.eye(3), (2, 3, 3)), one.by_shutter], axis=2)
        variances, axes = np.linalg.eigh(one.covariances)
        whiten = axes.swapaxes(1, 2) / np.sqrt(variances)[:, :, None]
        whiten[0] = axes[0] @ whiten[0]  # neighbours are compared along the same axes
        more = one.turned, design, whiten, whiten @ design, variances
        return _Whitened(*(
            np.concatenate([last[1 - _LAST :], each[None]])
            for last, each in zip(self, more, strict=True)
        ))  # fmt: skip

    def varying(self, values: Array, k: int) -> tuple[Array, Array]:
        """Return values (n,3) without their mean and what another shutter adds, also whitened.

        ``k``: 0 for rotations, 1 for changes.
        """
        rows, whitened = self.rows[:, k].reshape(-1, 5), self.whitened(values, k)
        normal = rows.T @ rows
        normal += _LEAST_TOLD * normal.trace() * np.eye(5)
        found = np.linalg.solve(normal, rows.T @ whitened.ravel())
        return values - self.design[:, k] @ found, whitened - self.rows[:, k] @ found

    def whitened(self, values: Array, k: int) -> Array:
        """Return values (n,3) of unit variance."""
        return (self.whiten[:, k] @ values[:, :, None])[:, :, 0]

    def likeness(self, values: Array, whitened: Array) -> tuple[float, float]:
        """Return how alike neighbours of rotations (n,3) are, in deviations, and their rms.

        Independent errors of neighbours leave their product as it is. In the rms products count by
        what is known of them: where a motion starts or stops, little is.
        """
        pairs = float(np.sum(whitened[1:] * whitened[:-1]))
        known = np.sqrt(np.sum(1.0 / self.variances[:, 0], axis=1))
        known = known[1:] * known[:-1]
        square = float(known @ np.sum(values[1:] * values[:-1], axis=1))
        square /= max(float(known.sum()), 1e-300)
        return pairs / math.sqrt(3.0 * len(values)), math.sqrt(max(square, 0.0))


_NONE = _Whitened(*(np.zeros((0, 2, 3, *more)) for more in ((), (5,), (3,), (5,), ())))


class RowRotations:
    """The rotations of the last frames beside those between images, compared."""

    def __init__(self) -> None:
        self._last = _NONE
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
        return len(self._last.turned) >= _LEAST

    def __len__(self) -> int:
        return len(self._last.turned)

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
        every = self._last = self._last.and_of(one)
        rates, bends = every.turned[:, 0], every.turned[:, 1]
        smooth, rate = every.likeness(rates, every.whitened(rates, 0))
        self.most = rate if smooth > _LIKELY else 0.0
        if not self.are_enough:
            return
        rates, whitened = every.varying(rates, 0)
        self._smooth, self.rate = every.likeness(rates, whitened)
        steps = readouts * (rates[1:] - rates[:-1])
        turning = np.concatenate([steps[:1], 0.5 * (steps[1:] + steps[:-1]), steps[-1:]])
        _, bent = every.varying(bends - turning, 1)
        more = (math.pi * readouts * self.rate) ** 2 / 3.0 / every.variances[:, 1]
        self._bent = 0.5 * float(np.sum(bent**2 * more / (1.0 + more) - np.log1p(more)))
        is_new = self.are_smooth and self._bent < -_LIKELY
        self.is_certain = is_new or (self.is_certain and self._smooth > _LIKELY)
