# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What is assumed of a motion and its camera before the points have their say."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.config import LocalizerConfig
from rs_localizer.core.gyro_rotation import GyroRotation
from rs_localizer.core.rig import Rig
from rs_localizer.core.scales import SPEEDS, Scales
from rs_localizer.core.state import ANGULAR
from rs_localizer.estimation.prior import (
    Prior,
    PriorTerms,
    held_terms,
    knows_motion,
    motion_terms,
    terms_at,
    with_measurements,
    with_turn,
)
from rs_localizer.solvers.table import Solver

# Where the readout time is unknown, that of a slow camera: its motion per readout is the largest.
_UNKNOWN_READOUT_TIME = 0.03


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

    map_deviation: float  # m
    focal_length: float  # px
    may_rest: bool  # nothing speaks for a motion but the points
    rolling: bool  # velocities are estimated
    scales: Scales  # of shaking, smooth errors and speed, as the frames before tell
    of_rest: float = 0.0  # logarithm of the odds for rest, beside those of any camera
    turn: TurnSeen | None = None  # by a gyroscope


def assumptions(
    span: float, rig: Rig, config: LocalizerConfig, solver: Solver
) -> tuple[PriorTerms, Assumed]:
    """What the configuration assumes of motion, cameras and map, per span of the row times.

    Args:
        span: s; 0: unknown.
    """
    span = span or _UNKNOWN_READOUT_TIME
    velocity, acceleration = config.velocity_prior, config.acceleration
    terms = (
        motion_terms(
            (velocity.angular * span, velocity.linear * span),
            (acceleration.angular * span**2, acceleration.linear * span**2),
        )
        if solver.rolling_shutter
        else held_terms()
    )
    return terms, Assumed(
        map_deviation=config.map_deviation,
        focal_length=rig.focal_length,
        may_rest=solver.rolling_shutter and min(velocity.angular, velocity.linear) > 0.0,
        rolling=solver.rolling_shutter,
        scales=Scales.nothing(),
    )


# Logarithm of the odds at which frames deny a typical speed.
_DENIED = -4.0
# What is denied never leaves less than this part of the configured speed: cameras start to move.
_SLOWEST = 0.1


def told_speed(terms: PriorTerms, prior: Prior | None) -> tuple[PriorTerms, Prior | None]:
    """The prior of the fastest motion that frames before leave possible, and what else they say."""
    if prior is None or knows_motion(prior) or prior.scales is None:
        return terms, prior
    possible = [
        part for part, odds in zip(SPEEDS, prior.scales.speeds, strict=True) if odds > _DENIED
    ]
    part = max(possible, default=1.0)
    if part == 1.0:
        return terms, prior
    part = max(part, _SLOWEST)
    odds = np.interp(part * np.array(SPEEDS), SPEEDS, prior.scales.speeds)
    scales = prior.scales._replace(speeds=odds)
    return terms_at(terms, part, False), replace(prior, scales=scales)


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
    if prior.scales is not None:
        assumed = replace(assumed, scales=prior.scales)
    return assumed


def known_terms(terms: PriorTerms, prior: Prior | None, turn: GyroRotation | None) -> PriorTerms:
    """The terms of the configuration and what is known of this frame, but for its motion."""
    if turn is not None:
        terms = with_turn(terms, turn.error)
    return terms if prior is None else with_measurements(terms, prior)


def turn_seen(terms: PriorTerms, turn: GyroRotation | None) -> TurnSeen | None:
    """What a known turn says of the speed, beside the prior of the configuration."""
    if turn is None:
        return None
    variance = sum(turn.error.diagonal()[:3].tolist()) / 3.0 + turn.rate_noise**2
    precision = float(terms.informations[0, ANGULAR.start, ANGULAR.start])
    typical = 1.0 / precision if precision > 0.0 else math.inf
    return TurnSeen(float(turn.rate @ turn.rate), variance, typical)
