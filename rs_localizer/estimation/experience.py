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
from rs_localizer.core.scales import INDEPENDENT, SPEED_MEMORY, SPEEDS, Scales
from rs_localizer.core.scales import joined as joined_scales
from rs_localizer.core.state import POSE
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.lens import DECIDED, credible, joined, odds_of
from rs_localizer.estimation.modes import FAR_LESS_PROBABLE
from rs_localizer.estimation.prior import WALKING, Prior

# A lens stays what it is, but its coefficients are not all of it: it is never known better than
# fifty frames tell.
_LENS_MEMORY = 0.98
# Before a lens is known to be off, one frame in so many is asked for it, and all where that is
# probable.
_EVERY = 16
# Smooth errors in excess (standard normal) that ask for it, too. With that of a frame that may be a
# lens's, 3 % of missing distortion were not found in 24 frames (test_lens).
_SUSPECTED = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Experience:
    """Scales of shaking, smooth errors and speed; and the lens."""

    scales: Scales
    lens: LensError | None = None  # as it seems; None: nobody asked
    frames: int = 1

    @property
    def odds(self) -> float:
        """Logarithm of those for a lens that is off."""
        return 0.0 if self.lens is None else odds_of(self.lens)

    @classmethod
    def of(cls, first: Estimate) -> Self:
        """That of one frame."""
        return cls(first.scales, first.of_lens)

    def and_of(self, newest: Estimate) -> Experience:
        """The experience after one more frame."""
        lens, seen = self.lens, newest.of_lens
        if seen is not None:
            lens = seen if lens is None else joined(lens, seen, _LENS_MEMORY)
        elif self.odds > DECIDED and newest.lens is None:  # the frame did without
            lens = None
        return Experience(joined_scales(self.scales, newest.scales), lens, self.frames + 1)

    def moving(
        self, remembered: Array, before: Estimate, after: Estimate, seconds: float,
        typical: VelocityPrior,
    ) -> Experience:  # fmt: skip
        """The experience with what two frames, and odds (5,) from before, say of typical speeds.

        How far the camera gets from frame to frame tells how fast it moves within them. A resting
        image is as probable as one of the slowest motion: the shutter may be a global one.
        """
        if min(typical.angular, typical.linear) == 0.0:
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
        odds = SPEED_MEMORY * remembered + INDEPENDENT * (newest - newest.max())
        # A camera may start to move.
        odds = np.maximum(odds - odds.max(), -FAR_LESS_PROBABLE)
        return replace(self, scales=self.scales._replace(speeds=odds))

    @property
    def prior(self) -> Prior:
        """For the next frame, of whose motion nothing is known."""
        return self.with_lens(Prior(scales=self.scales))

    def with_lens(self, prior: Prior) -> Prior:
        """What is known of the next frame, and the lens if it is off."""
        if self.lens is not None and self.odds > DECIDED and credible(self.lens):
            return replace(prior, lens=self.lens)
        probable = self.odds > 0.0 or self.scales.excess[-1] > _SUSPECTED
        if probable or self.frames % _EVERY == 0:
            return replace(prior, asks_lens=True)
        return prior
