# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The in-frame turn beside a rotation that is known (:mod:`rs_localizer.core.rotation_prior`).

Its coefficients ``k`` (:mod:`.linear_fit`) go with the motion ``x`` beside that rotation:

    k = A (x - x_0) + rest,     rest ~ N(0, Q)

With ``A x`` in the columns of the motion the prior of the rest is one of :class:`.TurnPrior`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.rotation_prior import ROTATION, WHOLE, RotationPrior
from rs_localizer.core.shutter import Motion
from rs_localizer.core.state import PARAMETERS
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.linear_fit import (
    BLOCKS,
    IN_FUNCTIONS,
    MIDDLE,
    TURNS,
    TurnPrior,
)
from rs_localizer.estimation.prior import Prior
from rs_localizer.estimation.robust import inverse_of

if TYPE_CHECKING:
    from rs_localizer.estimation.window import MotionSample

# Sizes of vibration that the other knowledge misses, over ordinary ones; none at first. Without the
# second, half of the twists before a small plane lie outside their regions (paired, gyro).
_MISSED = (0.0, 1.0, 30.0)
# Probability that it misses none.
_COMPLETE = 0.99
# Size of vibration, over an ordinary one, that is rounding.
_LEAST = 1e-4


class CoupledTurn(NamedTuple):
    """Prior of the in-frame turn beside a rotation that is known, given the motion beside it."""

    by_motion: Array  # (54,18)
    rest: TurnPrior


def coupled_turn(rotation: RotationPrior, predicted: bool) -> CoupledTurn:
    """Return the prior of the in-frame turn.

    Args:
        predicted: whether the motion is found near the one that is predicted.
    """
    place = np.arange(PARAMETERS) if predicted and rotation.predicted else ROTATION[:6]
    turn, own = BLOCKS["turn"], rotation.covariance[np.ix_(place, place)]
    across = rotation.covariance[turn][:, place]
    by_motion, scale = np.zeros((TURNS, PARAMETERS)), np.sqrt(own.diagonal())
    by_scaled = np.linalg.solve(own / np.outer(scale, scale), (across / scale).T).T
    by_motion[:, place] = by_scaled / scale
    rest = rotation.covariance[turn, turn] - by_motion[:, place] @ across.T
    each = [rest + (_LEAST**2 + missed**2) * np.eye(TURNS) for missed in _MISSED]
    informations, volumes = map(np.array, zip(*map(inverse_of, each), strict=True))
    odds = np.full(len(each), math.log((1.0 - _COMPLETE) / (len(each) - 1)))
    odds[0] = math.log(_COMPLETE)
    return CoupledTurn(by_motion, TurnPrior(informations, np.ones(1), -volumes, odds))


def whole_covariance(covariance: Array) -> Array:
    """Return the covariance (102,102) of an estimate by one (72,72) of a motion without its
    vibration and an in-frame turn.
    """
    by_both = IN_FUNCTIONS.copy()
    by_both[:PARAMETERS, PARAMETERS:] = MIDDLE
    whole: Array = by_both @ covariance @ by_both.T
    return whole


def with_turn(covariance: Array, rotation: RotationPrior) -> Array:
    """Return the covariance (102,102) of a motion (18,18) and what the rotation beside it is."""
    joint, turn = np.zeros((WHOLE, WHOLE)), BLOCKS["turn"]
    joint[:PARAMETERS, :PARAMETERS] = covariance
    joint[turn, turn] = rotation.covariance[turn, turn]
    whole: Array = IN_FUNCTIONS @ joint @ IN_FUNCTIONS.T
    return whole


class LastFrame(NamedTuple):
    """The last frame with a pose, for a prediction or a look back."""

    middle_ns: int
    motion: Motion
    covariance: Array  # (18,18)
    added: Array  # (18,18) that the prediction gets, but for the rotation
    fading: float  # of accelerations, in readouts; negative: before the frame


class Foretold(Protocol):
    """Knowledge that an aid has of a frame before its points."""

    @property
    def rotation(self) -> RotationPrior: ...
    @property
    def prior(self) -> Prior | None:
        """The prior of the motion without the rotation; None: no earlier frame tells of it."""

    def of(self, last: Estimate) -> Estimate:
        """Return the estimate that it makes of the last frame's."""


@runtime_checkable
class Aid(Protocol):
    """Who knows from readings how a camera turns, and learns from its frames.

    The frames ask :meth:`foresee` before each one, and tell of it by :meth:`agrees`.
    """

    def foresee(self, readings: Any, middle_ns: int, last: LastFrame | None) -> Foretold | None: ...
    def agrees(self, foretold: Any, found: Estimate, told: MotionSample) -> bool: ...
    def ahead(self, readings: Any, middle_ns: int, last: LastFrame | None) -> Foretold | None: ...
    def changed(self, readings: Any, seconds: float) -> float: ...
    def last_ns(self, readings: Any) -> int: ...
    def forget_delay(self) -> None: ...
    def reset(self) -> None: ...
    def snapshot(self) -> Aid: ...
    @property
    def agreed(self) -> bool: ...
    @property
    def contradicted(self) -> bool: ...
    @property
    def status(self) -> Any: ...
