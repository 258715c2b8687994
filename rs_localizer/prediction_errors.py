# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of predictions ahead of the images, learnt from the last ones.

The accelerations of the motion model fade within an image or two, which predicts the next image
best. Real accelerations last longer, and those of noise end at once: a tenth of a second ahead, the
model claims too small an error for the first and too large a one for the second. So the motions of
the last images are extrapolated to each new one, and their errors are compared with the claimed
ones. Each horizon has a factor for rotation, position, angular and linear velocity. Let ``e`` be
the step from prediction to estimate, ``P`` and ``C`` their covariances. The expected squared error,
given the image, over the claimed one is

    (e' P^-1 e + tr(P^-1 C)) / 3
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.state import MOTION_PARAMETERS, PARAMETERS
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.motion_window import MotionWindow, errors_ahead

# Horizons, as parts of the longest one: at 30 Hz and 0.1 s, one, two and three images.
_KNOTS = np.array([1.0, 2.0, 3.0]) / 3.0
# Weight of the newest image, so that some two dozen images count; weight of the first one.
_NEWEST, _FIRST = 0.08, 0.5
# Largest ratio of squared errors that one image may contribute.
_MOST = 20.0
# Smallest factor if the window has learnt its accelerations, and beside a gyroscope, where it has
# not.
_LEAST, _LEAST_UNLEARNT = 1.0, 0.1
# A factor rests on some twelve independent numbers, so regions follow F(3, 12) instead of
# chi-squared: the ratio of their 95 % bounds.
_FEW = 1.3


class PredictionErrors:
    """Factors of the variances of predictions, by how far ahead they look.

    Args:
        longest: s ahead, at most.
    """

    def __init__(self, longest: float) -> None:
        self._longest = longest
        self.reset()

    def reset(self) -> None:
        """Forget all images so far."""
        self._factors = np.ones((len(_KNOTS), 4))
        self._told = np.zeros(len(_KNOTS))  # images that tell of each
        self._least = _LEAST
        # When each of the last images was, the motion until then, and the shaking about it.
        self._past: list[tuple[int, MotionWindow, Array]] = []

    def add(self, found: Estimate, window: MotionWindow, swing: Array) -> None:
        """Compare what was predicted for an image, and predict from it.

        Args:
            found: its estimate.
            window: of the motion, until then.
            swing: (18,18) covariance of the shaking about that motion, per readout.
        """
        if self._longest <= 0.0:
            return
        self._least = _LEAST if found.turn is None else _LEAST_UNLEARNT
        apart, kept = math.inf, []  # s since the newest of the past
        for past in self._past:
            seconds = 1e-9 * (found.time_ns - past[0])
            if 0.0 < seconds <= 1.2 * self._longest:
                apart = seconds
                kept.append(past)
                self._learn(apart, errors_ahead(past[1], found, past[2]))
        if apart > 0.45 * _KNOTS[0] * self._longest:
            kept.append((found.time_ns, window, swing))
        self._past = kept

    def _learn(self, seconds: float, ratios: Array) -> None:
        if not np.isfinite(ratios).all():  # rounding errors are all that is left of a covariance
            return
        # Copies of this object keep theirs.
        self._told, self._factors = self._told.copy(), self._factors.copy()
        place = np.clip(seconds / self._longest, _KNOTS[0], _KNOTS[-1])
        for k, weight in enumerate(np.maximum(1.0 - np.abs(place - _KNOTS) / _KNOTS[0], 0.0)):
            if weight > 0.0:
                self._told[k] += weight
                newest = min(max(_NEWEST * weight, weight / (1.0 + self._told[k])), _FIRST)
                self._factors[k] += newest * (np.minimum(ratios, _MOST) - self._factors[k])

    def widened(self, predicted: Estimate, seconds: float) -> Estimate:
        """Widen the covariance of a prediction this many s ahead by the errors of earlier ones."""
        told = self._told > 0.0
        if not told.any():
            return predicted
        horizons = self._longest * _KNOTS[told]
        factors = [np.interp(seconds, horizons, of) for of in self._factors[told].T]
        scale = np.ones(PARAMETERS)
        scale[:MOTION_PARAMETERS] = np.repeat(np.sqrt(_FEW * np.maximum(factors, self._least)), 3)
        covariance = predicted.joint_covariance * np.outer(scale, scale)
        return replace(predicted, joint_covariance=covariance)
