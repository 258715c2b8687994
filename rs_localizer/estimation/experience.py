# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Experience of shaking, speed and errors of map and lens, which the next frames share."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rs_localizer.config import VelocityPrior
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.scales import INDEPENDENT, SPEED_MEMORY, SPEEDS, Scales, joined
from rs_localizer.core.state import POSE, VELOCITIES
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.modes import FAR_LESS_PROBABLE

# Smooth errors (px, root mean square) that nobody has who calibrated well: surveyed tags before a
# calibrated lens have 0.2; and the deviations of the logarithm that make it sure.
_MUCH, _SURELY = 0.3, 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Experience:
    """Scales of shaking, smooth errors and speed."""

    scales: Scales

    @classmethod
    def of(cls, first: Estimate) -> Self:
        """That of one frame."""
        return cls(first.scales)

    def and_of(self, newest: Estimate) -> Experience:
        """The experience after one more frame."""
        return Experience(joined(self.scales, newest.scales))

    @property
    def smooth_error(self) -> float:
        """Size (px) of what map or lens are surely off by; 0: perhaps of nothing."""
        mean, precision = self.scales.size.tolist()
        surely = precision > 0.0 and mean - _SURELY / math.sqrt(precision) > math.log(_MUCH)
        return math.exp(mean) if surely else 0.0

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
        step = _step(before, after)
        spread = before.joint_covariance[POSE, POSE] + after.joint_covariance[POSE, POSE]
        likelihoods = []
        for part in SPEEDS[1:]:
            fast = np.repeat([part * typical.angular, part * typical.linear], 3)
            covariance = spread + np.diag((seconds * fast) ** 2)
            squared = step @ np.linalg.solve(covariance, step)
            likelihoods.append(-0.5 * (squared + np.linalg.slogdet(covariance)[1]))
        newest = np.array([likelihoods[0], *likelihoods])
        odds = SPEED_MEMORY * remembered + INDEPENDENT * (newest - newest.max())
        # A camera may start to move.
        odds = np.maximum(odds - odds.max(), -FAR_LESS_PROBABLE)
        return replace(self, scales=self.scales._replace(speeds=odds))


def covering(before: Estimate, after: Estimate, seconds: float) -> Estimate:
    """The newest of two frames, its velocities uncertain by how far they are from the step's.

    Rows of a readout time that nobody knows may all have been exposed at once: then they show no
    motion, however fast the camera is.
    """
    off = _step(before, after) * after.span / seconds
    off -= np.concatenate([after.angular_velocity, after.linear_velocity])
    joint = after.joint_covariance.copy()
    joint[VELOCITIES, VELOCITIES] += np.outer(off, off)
    return replace(after, joint_covariance=joint)


def _step(before: Estimate, after: Estimate) -> Array:
    """Turn and way (6,) of the camera between two frames."""
    turn = so3.log(np.ascontiguousarray(before.rotation @ after.rotation.T))
    return np.concatenate([turn, after.rotation @ (after.position - before.position)])
