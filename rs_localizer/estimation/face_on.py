"""Planes that nearly face the camera: what one Gaussian cannot say of how they lean.

Foreshortening tells the square of a lean, perspective the lean itself, and the latter hardly where
a plane is small. Noise then looks like a lean of some degrees to either side, with a cost that is
steep beyond and flat between: the plane may face the camera just as well. So the posterior is cut
into pieces along the lean, by Gaussian windows whose sum is level, and each piece is a Gaussian of
its own:

    p(x) = sum_j p(x) w_j(x) / sum_j w_j(x),   w_j(x) = exp(-(lean(x) - lean_j)^2 / (2 width^2))
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.state import PARAMETERS, TURN, step_between
from rs_localizer.estimation.mirror import facing, mirrored
from rs_localizer.estimation.prior_terms import PriorTerms
from rs_localizer.estimation.refine import apply_step

# Larger leans (rad) have a pose of their own, and so have those of more standard deviations; what
# is known better than this (rad) needs no pieces.
_MOST_LEAN, _MOST_SPREADS, _LEAST_SPREAD = 0.35, 5.0, 0.025
# Pieces from the lean to the mirrored one, and the width of their windows in distances of them: the
# sum of the windows is level to 5 %.
_PIECES = 5
_WIDTH = 0.8
OVERLAP = math.log(_WIDTH * math.sqrt(2.0 * math.pi))
"""Logarithm of the sum of the windows."""


# Variances by which the pose that faces the camera must fit worse to be ruled out (once in 20,000).
RULED_OUT = 20.0
DENIED = 2.0
"""So many times more squared deviations than the fit has: a Gaussian denies that pose."""
NEARBY = 0.14
"""So near (rad) the pose that faces the camera is no other one."""
# Squared deviations within which the covariance speaks for it; what is known better than this (rad)
# leaves no doubt.
_WITHIN, _LEAST_SPREAD_OF_DOUBT = 1.0, 0.015
# rad^-2: it holds a lean, whatever the points say.
_HOLDING = 1e8


class Window(NamedTuple):
    """A Gaussian window about the lean of a state."""

    state: Array  # (24,)
    information: Array  # (18,18)

    def times(self, terms: PriorTerms) -> PriorTerms:
        """A prior within this window."""
        return terms._replace(
            informations=np.concatenate([terms.informations, self.information[None]]),
            references=np.concatenate([terms.references, self.state[None]]),
        )


def windows(points: Array, inliers: BoolArray, state: Array, covariance: Array) -> list[Window]:
    """Windows from the lean of a plane, past the one that faces the camera, to the mirrored one.

    Args:
        points: (n,3); inliers (n,) are those that count.
        state: (24,) the best motion.
        covariance: (18,18) of a Gaussian about it.

    Returns:
        none where that Gaussian says enough, or the points are no plane.
    """
    if covariance[0, 0] + covariance[1, 1] + covariance[2, 2] < _LEAST_SPREAD**2:
        return []
    other = mirrored(points, inliers, state)
    if other is None:
        return []
    step = step_between(state, other)
    angle = math.hypot(*step[TURN])
    axis, lean = step[TURN] / angle, 0.5 * angle
    spread = math.sqrt(axis @ covariance[TURN, TURN] @ axis)
    if spread < _LEAST_SPREAD or lean > min(_MOST_LEAN, _MOST_SPREADS * spread):
        return []
    information = np.zeros((PARAMETERS, PARAMETERS))
    information[TURN, TURN] = np.outer(axis, axis) / (_WIDTH * angle / (_PIECES - 1)) ** 2
    parts = np.linspace(0.0, 1.0, _PIECES)
    return [Window(apply_step(state, part * step), information) for part in parts]


def held_facing(
    points: Array, inliers: BoolArray, state: Array, covariance: Array
) -> Window | None:
    """A window that holds a plane so that it faces the camera; the arguments are as before.

    None where it does so anyway, leans clearly, or the covariance speaks for it: what is ruled out,
    or in, at a glance takes no fit.
    """
    if np.trace(covariance[TURN, TURN]) < _LEAST_SPREAD_OF_DOUBT**2:
        return None
    towards = facing(points, inliers, state)
    if towards is None:
        return None
    turn = step_between(state, towards)[TURN]
    lean = float(np.linalg.norm(turn))
    if lean > _MOST_LEAN or turn @ np.linalg.solve(covariance[TURN, TURN], turn) < _WITHIN:
        return None
    information = np.zeros((PARAMETERS, PARAMETERS))
    information[TURN, TURN] = _HOLDING / lean**2 * np.outer(turn, turn)
    return Window(towards, information)


def squared_deviations(covariance: Array, step: Array) -> float:
    """Of the pose of a step (n,), by a covariance (n,n)."""
    pose = slice(0, 6)
    return float(step[pose] @ np.linalg.solve(covariance[pose, pose], step[pose]))


def reaching(covariance: Array, step: Array, squares: float) -> Array:
    """The least wider covariance (n,n) of which a step is so many squared deviations, or less.

    What noise makes of a plane that faces the camera is a lean whose own Gaussian is thin: the
    square of the lean is told, to the same deviation at any lean, so that the plane faces the
    camera at half as many deviations as that Gaussian has it. Only the pose is looked at.
    """
    squared = squared_deviations(covariance, step)
    if not squared > squares:
        return covariance
    return covariance + (1.0 / squares - 1.0 / squared) * np.outer(step, step)
