# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What the frames so far say of shaking and of errors of map and lens: the next ones share them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rs_localizer.config import VelocityPrior
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.lens import LensError
from rs_localizer.core.scales import SPEEDS, Scales
from rs_localizer.core.scales import joined as joined_scales
from rs_localizer.core.state import POSE
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.lens import credible, joined, odds_of
from rs_localizer.estimation.prior import WALKING, Prior

# Frames farther apart (s) say little of how fast a camera moves; what those of a second say$
# together is less than their sum.
_LONGEST_GAP, _INDEPENDENT, _SPEED_MEMORY = 0.5, 0.3, 0.95
# Logarithm of the odds by which frames deny a typical speed at most: a camera may start to move,
# and what its points say then is far more.
_MOST_CERTAIN = 6.0
# A lens stays what it is, but two coefficients are not all of it: it is never known better than
# this (a tenth of a pixel at the corners of an image of 800 px across).
_LENS_MEMORY = 0.98
_LEAST_DEVIATION = 3e-4
# Logarithm of the odds beyond which a lens is taken to be off, and beyond which every frame is
# asked for it. Before, one in so many is, and where smooth errors are in excess (standard normal).
_DECIDED, _ASKED = 10.0, 2.0
_EVERY = 16
_SUSPECTED = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Experience:
    """Scales of shaking, smooth errors and speed; and the lens."""

    scales: Scales
    lens: LensError | None = None  # as it seems; None: nobody asked
    odds: float = 0.0  # for a lens that is off, logarithm
    frames: int = 1

    @classmethod
    def of(cls, first: Estimate) -> Self:
        """That of one frame."""
        odds = 0.0 if first.of_lens is None else odds_of(first.of_lens)
        return cls(first.scales, first.of_lens, odds)

    def and_of(self, newest: Estimate) -> Experience:
        """The experience after one more frame."""
        lens, odds, seen = self.lens, self.odds, newest.of_lens
        if seen is not None:
            lens = seen if lens is None else joined(lens, seen, _LENS_MEMORY)
            odds = odds_of(lens)
        elif self.odds > _DECIDED and newest.lens is None:  # the frame did without
            lens, odds = None, 0.0
        return Experience(
            joined_scales(self.scales, newest.scales),
            lens,
            odds,
            self.frames + 1,
        )

    def moving(
        self, remembered: Array, before: Estimate, after: Estimate, seconds: float,
        typical: VelocityPrior,
    ) -> Experience:  # fmt: skip
        """The experience with what two frames, and odds (5,) from before, say of typical speeds.

        How far the camera gets from frame to frame tells how fast it moves within them. A resting
        image is as probable as one of the slowest motion: the shutter may be a global one.
        """
        if not 0.0 < seconds < _LONGEST_GAP or min(typical.angular, typical.linear) == 0.0:
            return self
        turn = so3.log(np.ascontiguousarray(before.rotation @ after.rotation.T))
        step = np.concatenate([turn, after.rotation @ (after.position - before.position)])
        spread = before.joint_covariance[POSE, POSE] + after.joint_covariance[POSE, POSE]
        likelihoods = []
        for part in SPEEDS[1:]:
            fast = np.repeat([part * typical.angular, max(part, WALKING) * typical.linear], 3)
            covariance = spread + np.diag((seconds * fast) ** 2)
            squared = step @ np.linalg.solve(covariance, step)
            likelihoods.append(-0.5 * (squared + np.linalg.slogdet(covariance)[1]))
        newest = np.array([likelihoods[0], *likelihoods])
        odds = _SPEED_MEMORY * remembered + _INDEPENDENT * (newest - newest.max())
        odds = np.maximum(odds - odds.max(), -_MOST_CERTAIN)
        return replace(self, scales=self.scales._replace(speeds=odds))

    @property
    def prior(self) -> Prior:
        """For the next frame, of whose motion nothing is known."""
        prior = Prior(scales=self.scales)
        return self.with_lens(prior) or prior

    def with_lens(self, prior: Prior | None) -> Prior | None:
        """What is known of the next frame, and the lens if it is off."""
        if prior is None:
            return None
        if self.lens is not None and self.odds > _DECIDED and credible(self.lens):
            least = _LEAST_DEVIATION**2 * np.eye(len(self.lens.mean))
            lens = replace(self.lens, covariance=self.lens.covariance + least)
            return replace(prior, lens=lens)
        seen = self.scales.excess[-1] > _SUSPECTED
        if seen or self.odds > _ASKED or self.frames % _EVERY == 0:
            return replace(prior, asks_lens=True)
        return prior
