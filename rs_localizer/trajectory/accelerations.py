"""What the keypoints say of a motion's accelerations (MacKay, "Bayesian interpolation", Neural
Computation 4, 1992).

The accelerations of an estimate are too small, as far as the prior took the place of what the
keypoints do not tell; and their squares are the sum of as many numbers only as these do tell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.trajectory.fit import Fit
from rs_localizer.trajectory.model import Freedom
from rs_localizer.trajectory.prior_kernels import changes
from rs_localizer.trajectory.sight_kernels import Curve

# Those of a camera at rest are expected to be at least this (rad/s^2, m/s^2).
_LEAST = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What an estimate says of its prior, of angular and of linear accelerations."""

    squares: Array  # (2,) sums, (rad/s^2)^2 and (m/s^2)^2
    numbers: Array  # (2,) how many of them the keypoints tell

    def most_likely(self, freedom: Freedom) -> Freedom:
        """The same with accelerations one step nearer to the greatest marginal likelihood."""
        angular, linear = np.sqrt(self.squares / np.maximum(self.numbers, 1.0))
        return replace(
            freedom,
            angular_acceleration=max(float(angular), _LEAST),
            linear_acceleration=max(float(linear), _LEAST),
        )


def told(found: Fit) -> Told:
    """What an estimate says of the accelerations that were expected of it."""
    spline, firsts = found.state.spline, found.state.spline.layout.firsts
    about = np.concatenate([
        np.maximum(np.arange(first - 1, last - 3), first)
        for first, last in pairwise(firsts)
    ])  # fmt: skip
    curve = Curve(spline.rotations, spline.positions, *spline.steps(), spline.layout.spacing)
    prior, sums = found.freedom.accelerations(spline.layout.spacing), np.empty((2, 2))
    changes(curve, firsts, prior.memory, found.factored.local_covariances(about), sums)
    squares, variances = sums
    numbers = 3 * len(about) - variances / np.array([prior.angular, prior.linear]) ** 2
    return Told(squares, numbers)
