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

# What is known beforehand: as much as so many numbers of this size (rad/s^2, m/s^2) would tell. A
# few images that happen to lie on a line say nothing of those that follow.
_NUMBERS, _USUAL = 6.0, np.array([2.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What an estimate says of its prior, of angular and of linear accelerations."""

    squares: Array  # (2,) sums, (rad/s^2)^2 and (m/s^2)^2
    numbers: Array  # (2,) how many of them the keypoints tell

    def most_likely(self, freedom: Freedom) -> Freedom:
        """The same with accelerations one step nearer to the greatest marginal likelihood."""
        squares = self.squares + _NUMBERS * _USUAL**2
        angular, linear = np.sqrt(squares / (np.maximum(self.numbers, 0.0) + _NUMBERS))
        return replace(
            freedom, angular_acceleration=float(angular), linear_acceleration=float(linear)
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
