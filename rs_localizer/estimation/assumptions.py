"""What is assumed of a motion and its camera before the points have their say."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.config import LocalizerConfig
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.known_turn import KnownTurn
from rs_localizer.core.state import ANGULAR
from rs_localizer.estimation.prior import Prior
from rs_localizer.estimation.prior_terms import (
    PriorTerms,
    held_terms,
    motion_terms,
    with_measurements,
    with_turn,
)
from rs_localizer.solvers.table import Solver

# Where the readout time is unknown, that of a slow camera: its motion per readout is the largest.
_UNKNOWN_READOUT_TIME = 0.03
# Accelerations change at the pace of two hertz, rad/s.
_JERK_RATE = 4.0 * math.pi
# Third derivative of the cubic among the polynomials of the shaking.
_JERK_OF_CUBIC = 120.0
# Sizes to try, as multiples of the least, and their probabilities.
SHAKE_SIZES = 10.0 ** np.arange(0.0, 5.1)
SHAKE_PRIOR = np.array([0.6, 0.15, 0.12, 0.09, 0.03, 0.01])
FIELD_SIZES = 10.0 ** np.arange(0.0, 2.1, 0.5)
# Lenses and maps are never better than this, px: a hundredth. Careful ones, surveyed tags before a
# calibrated lens, have errors of 0.1 to 0.2; whose errors are a pixel, are rare.
_LEAST_FIELD = 0.01
FIELD_PRIOR = np.array([0.4, 0.25, 0.26, 0.088, 0.002])


@dataclass(frozen=True, slots=True)
class TurnSeen:
    """What a gyroscope says of the speed of a motion."""

    squared_rate: float  # (rad per readout)^2
    variance: float  # of each axis, if the camera is at rest
    typical_variance: float  # of each axis, by the prior of the motion

    def evidence(self, speed: float) -> float:
        """Logarithm of the likelihood of a typical speed, but for a constant."""
        variance = self.variance + speed**2 * self.typical_variance
        return -0.5 * (self.squared_rate / variance + 3.0 * math.log(variance))


@dataclass(frozen=True, slots=True, eq=False)
class Assumed:
    """What is assumed of a camera and its map, beside the prior of the motion."""

    shake: float  # rad, of each polynomial: as much as the jerk of an ordinary motion
    map_deviation: float  # m
    focal_length: float  # px
    # Logarithms of the odds of each size beside those of any camera: what its last frames said.
    of_shake_sizes: Array
    of_field_sizes: Array
    may_rest: bool  # nothing speaks for a motion but the points
    rolling: bool  # velocities are estimated
    of_tones: Array | None = None  # of each against none, by the last frames
    of_rest: float = 0.0  # logarithm of the odds for rest, beside those of any camera
    turn: TurnSeen | None = None  # by a gyroscope

    def field_sizes(self, depth: float) -> Array:
        """Standard deviations (k,) of the field to try, px, of points so far away (m)."""
        least = math.hypot(_LEAST_FIELD, self.map_deviation * self.focal_length / depth)
        sizes: Array = least * FIELD_SIZES
        return sizes


def assumptions(
    camera: Camera, config: LocalizerConfig, solver: Solver
) -> tuple[PriorTerms, Assumed]:
    """What the configuration assumes of motion, camera and map, per readout."""
    readout_time = camera.readout_time or _UNKNOWN_READOUT_TIME
    velocity, acceleration = config.velocity_prior, config.acceleration
    terms = (
        motion_terms(
            (velocity.angular * readout_time, velocity.linear * readout_time),
            (acceleration.angular * readout_time**2, acceleration.linear * readout_time**2),
        )
        if solver.rolling_shutter
        else held_terms()
    )
    jerk = acceleration.angular * _JERK_RATE * readout_time**3
    return terms, Assumed(
        shake=jerk / _JERK_OF_CUBIC,
        map_deviation=config.map_deviation,
        focal_length=camera.focal_length,
        of_shake_sizes=np.zeros(len(SHAKE_SIZES)),
        of_field_sizes=np.zeros(len(FIELD_SIZES)),
        may_rest=solver.rolling_shutter and min(velocity.angular, velocity.linear) > 0.0,
        rolling=solver.rolling_shutter,
    )


def with_experience(assumed: Assumed, prior: Prior | None, turn: TurnSeen | None) -> Assumed:
    """The assumptions and what gyroscope and earlier frames say of turn, rest, shaking, model
    error.
    """
    if turn is not None:
        assumed = replace(assumed, turn=turn)
    if prior is None:
        return assumed
    if prior.of_rest != 0.0:
        assumed = replace(assumed, of_rest=prior.of_rest)
    if prior.of_tones is not None:
        assumed = replace(assumed, of_tones=prior.of_tones)
    if prior.of_shake_sizes is None or prior.of_field_sizes is None:
        return assumed
    return replace(
        assumed, of_shake_sizes=prior.of_shake_sizes, of_field_sizes=prior.of_field_sizes
    )


def known_terms(terms: PriorTerms, prior: Prior | None, turn: KnownTurn | None) -> PriorTerms:
    """The terms of the configuration and what is known of this frame, but for its motion."""
    if turn is not None:
        terms = with_turn(terms, turn.error)
    return terms if prior is None else with_measurements(terms, prior)


def turn_seen(terms: PriorTerms, turn: KnownTurn | None) -> TurnSeen | None:
    """What a known turn says of the speed, beside the prior of the configuration."""
    if turn is None:
        return None
    variance = sum(turn.error.diagonal()[:3].tolist()) / 3.0 + turn.rate_noise**2
    precision = float(terms.informations[0, ANGULAR.start, ANGULAR.start])
    typical = 1.0 / precision if precision > 0.0 else math.inf
    return TurnSeen(float(turn.rate @ turn.rate), variance, typical)
