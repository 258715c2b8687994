"""What is assumed of a motion and its camera before the points have their say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rs_localizer.config import LocalizerConfig
from rs_localizer.core.camera import Camera
from rs_localizer.core.known_turn import KnownTurn
from rs_localizer.core.state import ANGULAR
from rs_localizer.estimation.prior import (
    Prior,
    PriorTerms,
    held_terms,
    motion_terms,
    with_measurements,
    with_turn,
)
from rs_localizer.estimation.settling import FIELD_SIZES, SHAKE_SIZES, Assumed, TurnSeen
from rs_localizer.solvers.table import Solver

# Where the readout time is unknown, that of a slow camera: its motion per readout is the largest.
_UNKNOWN_READOUT_TIME = 0.03
# Accelerations change at the pace of two hertz, rad/s.
_JERK_RATE = 4.0 * math.pi
# Third derivative of the cubic among the polynomials of the shaking.
_JERK_OF_CUBIC = 120.0


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
        of_shake_sizes=np.zeros(SHAKE_SIZES),
        of_field_sizes=np.zeros(FIELD_SIZES),
        may_rest=solver.rolling_shutter and min(velocity.angular, velocity.linear) > 0.0,
        rolling=solver.rolling_shutter,
    )


def with_experience(assumed: Assumed, prior: Prior | None, turn: TurnSeen | None) -> Assumed:
    """The assumptions and what gyroscope and earlier frames say of turn, shaking, model error."""
    if turn is not None:
        assumed = replace(assumed, turn=turn)
    if prior is None or prior.of_shake_sizes is None or prior.of_field_sizes is None:
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
    variance = float(np.trace(turn.error[:3, :3])) / 3.0 + turn.rate_noise**2
    precision = float(terms.informations[0][ANGULAR, ANGULAR][0, 0])
    typical = 1.0 / precision if precision > 0.0 else math.inf
    return TurnSeen(float(turn.rate @ turn.rate), variance, typical)
