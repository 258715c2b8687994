# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How far predictions ahead of the images are off, by how far the last ones were.

The motion model's accelerations fade within an image or two, which predicts the next image best.
Real ones last longer, those of noise are over at once: a tenth of a second ahead, the first are off
by more than the model says, the second by less. So the motions of the last images are carried on to
each new one, and their errors compared with what was claimed: per horizon, a factor each for turn,
place, angular and linear velocity. With the step ``e`` from prediction to estimate, ``P`` and ``C``
their covariances, the expected squared error by what the image tells is, over the claimed one,

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
# Weight of the newest: some two dozen images count.
_NEWEST, _FIRST = 0.08, 0.5
# One image counts as that much, at most.
_MOST = 20.0
# Accelerations that a window has learnt are never less; beside a gyroscope nobody has learnt them.
_LEAST, _LEAST_UNLEARNT = 1.0, 0.1
# Some twelve independent numbers tell of a factor: as wide as 95 % of F(3, 12), not chi-squared's.
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
        """A prediction so many s after an image with the covariance that its like deserved."""
        told = self._told > 0.0
        if not told.any():
            return predicted
        horizons = self._longest * _KNOTS[told]
        factors = [np.interp(seconds, horizons, of) for of in self._factors[told].T]
        scale = np.ones(PARAMETERS)
        scale[:MOTION_PARAMETERS] = np.repeat(np.sqrt(_FEW * np.maximum(factors, self._least)), 3)
        covariance = predicted.joint_covariance * np.outer(scale, scale)
        return replace(predicted, joint_covariance=covariance)
