# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Priors of the motion before the image: Gaussians, a known rotation, gravity's direction.

:class:`Prior` is what a user gives, :class:`PriorTerms` what kernels take, and :func:`add_prior`
what it adds to the normal equations. :func:`assumptions` makes them of the configuration.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.config import LocalizerConfig, RefinementKind
from rs_localizer.core.arrays import Array, Array1, Array2, Array3, IntArray, Out, real
from rs_localizer.core.camera import numbers
from rs_localizer.core.rig import Rig
from rs_localizer.core.rotation_prior import ROTATION, RotationPrior
from rs_localizer.core.shutter import Motion
from rs_localizer.core.so3 import hat_of, log
from rs_localizer.core.state import (
    ACCELERATIONS,
    ANGULAR,
    ANGULAR_ACCELERATION,
    LINEAR,
    MOTION_PARAMETERS,
    PARAMETERS,
    STATE_ANGULAR,
    STATE_SIZE,
)
from rs_localizer.core.types import altered
from rs_localizer.native import entry, inlined
from rs_localizer.solvers.table import Solver

if TYPE_CHECKING:  # which needs this module
    from rs_localizer.estimation.known_rotation import CoupledTurn

# Rounding error of an orthonormal matrix, or of a symmetric one with a unit diagonal.
ROUNDING = 1e-6
# Least eigenvalue of a covariance scaled to a unit diagonal; smaller ones are rounding.
_LEAST_EIGENVALUE = 1e-12
# Squares of larger numbers, and inverses of smaller variances, are infinite.
_FARTHEST, _LEAST_VARIANCE = 1e150, 1e-100
# Rates of a turn and their changes, in a step.
_RATES = np.r_[ANGULAR, ANGULAR_ACCELERATION]
_TURNING = np.ix_(_RATES, _RATES)


def check_motion(motion: Motion) -> None:
    """Check that a motion may be one that is expected.

    Raises:
        ValueError: wrong shapes, values that are not finite, a rotation that is none.
    """
    for name in (each.name for each in fields(Motion)):
        value, shape = (
            np.asarray(getattr(motion, name), float),
            (3, 3) if name == "rotation" else (3,),
        )
        if value.shape != shape:
            raise ValueError(
                f"the prior motion's {name} must be of shape {shape}, got {value.shape}"
            )
        if not np.all(np.abs(value) < _FARTHEST):
            raise ValueError(f"the prior motion's {name} is not finite: {value}")
    rotation = np.asarray(motion.rotation, float)
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not (off <= ROUNDING and np.linalg.det(rotation) > 0.0):
        raise ValueError(f"the prior motion's rotation is not orthonormal: {rotation.tolist()}")


def check_covariance(covariance: Array) -> None:
    """Check that an array may be a prior motion's covariance; infinite variances know nothing.

    Raises:
        ValueError: wrong shape, values that are not finite, no covariance.
    """
    if covariance.shape not in ((MOTION_PARAMETERS,) * 2, (PARAMETERS,) * 2):
        raise ValueError(f"covariance must be (12,12) or (18,18), got {covariance.shape}")
    flaw = _flaw(np.ascontiguousarray(covariance, np.float64))
    if flaw >= 0:
        raise ValueError(f"covariance must be {_FLAWS[flaw]}")


_FLAWS = ("finite where its diagonal is", "symmetric", "positive definite")


@entry
def _flaw(covariance: Array2) -> int:
    """Return which of the flaws a covariance has, or -1: none."""
    known = np.flatnonzero(~np.isinf(np.diag(covariance)))
    block = covariance[known][:, known].copy()
    if not np.all(np.isfinite(block)):
        return 0
    scale = np.sqrt(np.maximum(np.diag(block), _LEAST_VARIANCE))
    block /= np.outer(scale, scale)
    if not np.all(np.abs(block - block.T) <= ROUNDING):
        return 1
    definite = len(known) == 0 or np.linalg.eigvalsh(block)[0] > _LEAST_EIGENVALUE
    return -1 if definite else 2


# Least deviation of a measurement; with it a velocity is held at its mean whatever the points say.
_LEAST_DEVIATION = 1e-9
# Of a direction; with more it may point anywhere.
_MOST_DEVIATION = math.pi / 2.0, " rad"


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Knowledge of one frame besides its points; give any of the three.

    Args:
        motion, covariance: expected motion and its (12,12) covariance, in the order of
            ``Estimate.covariance``, or (18,18) with its accelerations, in the order of
            ``Estimate.joint_covariance``; infinite variances leave a parameter free.
        angular_velocity, angular_velocity_deviation: a measured body rate (3,) in camera axes times
            the readout time (rad per readout), and its standard deviation.
        of_rest: logarithm of the odds that the camera does not move within the image, beside
            those of any camera.
        of_vibration: (k,) logarithms of the odds of each vibration against none by other frames,
            beside those of any camera (``Estimate.vibrations``); empty: there were none.
        gravity, gravity_deviation: a vector (3,) in camera axes at the middle row that points
            along ``gravity_in_map``, of any length, and the standard deviation of its direction
            in rad.

    Raises:
        ValueError: wrong shapes, values that are not finite, deviations that are not positive.
    """

    motion: Motion | None = None
    covariance: Array | None = None
    angular_velocity: ArrayLike | None = None
    angular_velocity_deviation: float = math.nan
    gravity: ArrayLike | None = None
    gravity_deviation: float = math.nan
    gravity_in_map: ArrayLike = (0.0, 0.0, -1.0)
    of_rest: float = 0.0
    of_vibration: Array = field(default_factory=np.zeros(0).copy)

    def __post_init__(self) -> None:
        if (self.motion is None) != (self.covariance is None):
            raise ValueError("a prior motion and its covariance go together")
        if self.motion is not None and self.covariance is not None:
            check_motion(self.motion)
            check_covariance(np.asarray(self.covariance, float))
        for name in ("angular_velocity", "gravity", "gravity_in_map"):
            vector = getattr(self, name)
            if vector is None:
                continue
            array = numbers(name, vector)
            if array.shape != (3,) or not np.all(np.isfinite(array)):
                raise ValueError(f"{name} must be three finite numbers, got {vector!r}")
            if name != "angular_velocity" and not np.abs(array).max() > 0.0:
                raise ValueError(f"{name} has no direction: {vector!r}")
            deviation = getattr(self, f"{name}_deviation", 1.0)
            most, unit = _MOST_DEVIATION if name == "gravity" else (sys.float_info.max, "")
            between = f"between {_LEAST_DEVIATION:g} and {most:.3g}{unit}"
            real(f"{name}_deviation", deviation, between, _LEAST_DEVIATION, most)


_NOTHING = Prior()


def predicted(motion: Motion, covariance: Array) -> Prior | None:
    """Return the prior that a track predicts; None if its covariance is left with rounding errors.

    The motion is one that was found, and is not checked again.
    """
    try:
        check_covariance(covariance)
    except ValueError:
        return None
    return altered(_NOTHING, motion=motion, covariance=covariance)


def state_in(motion: Motion, centre: Array) -> Array:
    """State (24,) of a motion for points taken relative to ``centre`` (3,)."""
    rotation = np.asarray(motion.rotation, float)
    translation = motion.translation + rotation @ centre
    return np.concatenate(
        [
            rotation.ravel(), translation, motion.angular_velocity, motion.linear_velocity,
            motion.angular_acceleration, motion.linear_acceleration,
        ]
    )  # fmt: skip


# Ridge, a share of the rotation's variance, for an axis about which it may not rotate.
RIDGE = 1e-9
# A tenth of the speed goes with the accelerations of the whole. If any did, orientations of the
# first row under one sine would be off by 3 % more (benchmarks.frames sine, 16 frames).
_JOLTS = 10.0
# Least part of the configured linear velocity that goes with a slower turn.
_WALKING = 0.1

SPEEDS = (0.0, 0.03, 0.1, 0.3, 1.0)
"""Typical speeds, as parts of the configured one; 0 is a camera at rest."""


class PriorTerms(NamedTuple):
    """A prior as the kernels take it: a sum of Gaussians, and a direction."""

    informations: Array3  # (k,18,18)
    references: Array2  # (k,24) states of their means
    gravity: Array1  # (7,) in the map, in the camera, precision
    pivots: Array2  # (k,3) about which they turn, in the axes of the means: see offset_between


_STILL = np.concatenate([np.eye(3).ravel(), np.zeros(STATE_SIZE - 9)])


def motion_terms(velocities: Sequence[float], accelerations: Sequence[float]) -> PriorTerms:
    """Return a zero-mean prior with these standard deviations, angular and linear; 0: none.

    Args:
        velocities: rad and m per readout.
        accelerations: rad and m per readout squared.
    """
    precisions = [0.0 if d == 0.0 else d**-2 for d in (*velocities, *accelerations)]
    return _single(np.diag(np.concatenate([np.zeros(6), np.repeat(precisions, 3)])), _STILL)


# Velocities and accelerations are zero.
_HELD = np.diag(np.repeat([0.0, _LEAST_DEVIATION**-2], [6, 12]))


@cache
def held_terms() -> PriorTerms:
    """Return the prior of a global shutter: velocities and accelerations are zero."""
    return _single(_HELD, _STILL)


@entry
def terms_at(terms: PriorTerms, speed: float, turn_known: bool) -> PriorTerms:
    """Return the prior of a typical speed, a part of the configured one; 0: at rest.

    Neither travel nor accelerations slow down as much as turns: who hardly turns may walk, and
    jolts come at any speed. At rest, only gravity is as in the terms. What a known
    rotation leaves of a turn does not depend on the speed.
    """
    count = 1 if speed == 0.0 else len(terms.informations)
    informations = terms.informations[:count].copy()
    first = informations[0]
    if speed == 0.0:
        first[:] = _HELD
    else:
        first[ANGULAR] /= speed**2
        first[LINEAR] /= max(speed, _WALKING) ** 2
        first[ACCELERATIONS] /= min(_JOLTS * speed, 1.0) ** 2
    if turn_known:
        for i in _RATES:
            for j in _RATES:
                first[i, j] = terms.informations[0, i, j]
    return PriorTerms(
        informations, terms.references[:count].copy(), terms.gravity.copy(),
        terms.pivots[:count].copy(),
    )  # fmt: skip


def _single(information: Array, reference: Array) -> PriorTerms:
    return PriorTerms(information[None], reference[None].copy(), np.zeros(7), np.zeros((1, 3)))


def with_measurements(terms: PriorTerms, prior: Prior) -> PriorTerms:
    """Add the angular velocity and gravity of a prior to the terms."""
    if prior.angular_velocity is not None:
        information, reference = np.zeros((PARAMETERS, PARAMETERS)), _STILL.copy()
        information[ANGULAR, ANGULAR] = np.eye(3) / prior.angular_velocity_deviation**2
        reference[STATE_ANGULAR] = prior.angular_velocity
        terms = _with_term(terms, information, reference, np.zeros(3))
    if prior.gravity is not None:
        directions = _unit(prior.gravity_in_map), _unit(prior.gravity)
        gravity = np.append(np.concatenate(directions), prior.gravity_deviation**-2)
        terms = terms._replace(gravity=gravity)
    return terms


def _with_term(terms: PriorTerms, information: Array, reference: Array, pivot: Array) -> PriorTerms:
    """Add a Gaussian (18,18) about a state (24,), with its pivot (3,), behind the others."""
    return PriorTerms(
        np.concatenate([terms.informations, information[None]]),
        np.concatenate([terms.references, reference[None]]), terms.gravity,
        np.concatenate([terms.pivots, pivot[None]]),
    )  # fmt: skip


def knows_motion(prior: Prior) -> bool:
    """Return True if a prior's motion is more than a first guess."""
    return prior.covariance is not None and not np.isinf(prior.covariance.diagonal()).all()


def knows_speed(terms: PriorTerms, prior: Prior) -> bool:
    """Return True if a prior knows the linear velocity better than the terms do."""
    default = terms.informations[0].diagonal()[LINEAR]
    return bool((np.asarray(prior.covariance).diagonal()[LINEAR] * default < 1.0).all())


def at_speed(terms: PriorTerms, speed: float) -> PriorTerms:
    """Return terms whose linear velocity may also be as large as ``speed``, m per readout."""
    informations = terms.informations.copy()
    informations[0, LINEAR] /= 1.0 + informations[0, LINEAR.start, LINEAR.start] * speed**2
    return terms._replace(informations=informations)


def with_motion(
    terms: PriorTerms, prior: Prior, centre: Array, turn_known: bool = False
) -> PriorTerms:
    """Add a prior's motion in the map frame, for points relative to ``centre`` (3,).

    Its term, if it knows anything, is the last one. Beside a known rotation it knows the
    errors of that, too.
    """
    if prior.motion is None or not knows_motion(prior):
        return terms
    covariance = np.ascontiguousarray(prior.covariance, np.float64)
    if len(covariance) == PARAMETERS:  # it knows the accelerations better than a default
        terms = terms._replace(informations=terms.informations.copy())
        terms.informations[0, ACCELERATIONS] = 0.0
        if turn_known:
            terms.informations[0][_TURNING] = 0.0
        terms = at_speed(terms, float(np.linalg.norm(prior.motion.linear_velocity)))
    information = _information_of(covariance)
    return _with_term(terms, information, state_in(prior.motion, centre), pivot_of(covariance))


@entry
def _information_of(covariance: Array2) -> Array:
    """Return the information (18,18) of a covariance, in which infinite variances know nothing."""
    known, information = np.flatnonzero(np.isfinite(np.diag(covariance))), np.zeros_like(_HELD)
    block = np.linalg.inv(covariance[known][:, known].copy())
    for i in range(len(known)):
        for j in range(len(known)):
            information[known[i], known[j]] = block[i, j]
    return information


@entry
def pivot_of(covariance: Array2) -> Array:
    """Return the point (3,), in camera axes, whose place in the view is known best.

    Who turns about it moves by its distance times the turn: that is the part of the move that goes
    with the turn. A camera that a measured position holds turns about itself.
    """
    pivot, block = np.zeros(3), covariance[:3, :3].copy()
    if np.all(np.isfinite(covariance[:6, :6])):
        along, turned = covariance[:3, 3:6], (1.0 + RIDGE) * np.trace(block) * np.eye(3) - block
        vector = np.array([
            along[1, 2] - along[2, 1], along[2, 0] - along[0, 2], along[0, 1] - along[1, 0]
        ])  # fmt: skip
        pivot = np.linalg.inv(turned) @ vector
    return pivot if np.all(np.isfinite(pivot)) else np.zeros(3)


def _unit(vector: ArrayLike) -> Array:
    array = np.asarray(vector, float)
    array = array / np.abs(array).max()  # squares of very long vectors overflow
    unit: Array = array / np.linalg.norm(array)
    return unit


@entry
def add_prior(
    terms: PriorTerms, state: Array1, weight: float, information: Out[Array2], slope: Out[Array1]
) -> float:
    """Add the prior's part, times ``weight``, to the normal equations; returns its cost.

    These are of all 18 parameters, or of the first 12, while the accelerations are what they are.
    """
    cost, size = 0.0, len(slope)
    for term in range(len(terms.informations)):
        reference, known = terms.references[term], terms.informations[term]
        posed = np.any(np.diag(known)[:6] > 0.0)
        if posed:
            offset, by_turn = offset_between(reference, state, terms.pivots[term])
        else:  # without the logarithm of a rotation
            offset, by_turn = np.zeros(PARAMETERS), np.zeros((6, 3))
            offset[6:] = state[12:] - reference[12:]
        pulled, first = known @ offset, 0 if posed else 6
        cost += weight * np.sum(offset * pulled)
        if posed:  # J^T P J and J^T p: J is the identity but for the columns of the turn
            known = known.copy()
            known[:, :3] = known[:, :6].copy() @ by_turn
            known[:3] = by_turn.T @ known[:6].copy()
            pulled[:3] = by_turn.T @ pulled[:6]
        for i in range(first, size):
            slope[i] += weight * pulled[i]
            for j in range(first, size):
                information[i, j] += weight * known[i, j]
    if terms.gravity[6] > 0.0:
        cost += _add_gravity(terms.gravity, state, weight, information, slope)
    return cost


@entry
def offset_between(reference: Array1, state: Array1, pivot: Array1) -> tuple[Array, Array]:
    """Return the offset (18,) between two states, and its derivative (6,3) by a rotation.

    Its turn ``phi`` is that of a step, its move what turns and then sees the pivot ``p`` at ``q``:

        phi x p = -(p x phi),      move = p x phi - (q - p),

    a step's to first order. What an image says is nearly Gaussian in it, far along the arcs about
    the points, where a step's move leaves its tangent. By a move, it changes as the step does.
    """
    before, after = reference[:9].copy().reshape(3, 3), state[:9].copy().reshape(3, 3)
    relative = before @ after.T  # reference from state: exp([turn]x)
    turn = log(relative)
    seen = state[9:12] + relative.T @ (pivot - reference[9:12])
    offset, by_turn = np.empty(PARAMETERS), np.empty((6, 3))
    offset[:3], offset[6:] = turn, state[12:] - reference[12:]
    about = hat_of(pivot)
    offset[3:6] = about @ turn + pivot - seen
    # Inverse right Jacobian of the exponential; its second coefficient is 1/12 at zero.
    squared = np.sum(turn * turn)
    angle, second = math.sqrt(squared), 1.0 / 12.0
    if angle > 1e-3:
        second = (1.0 - 0.5 * angle * math.sin(angle) / (1.0 - math.cos(angle))) / squared
    crossed = hat_of(turn)
    by_turn[:3] = np.eye(3) + 0.5 * crossed + second * (crossed @ crossed)
    by_turn[3:] = about @ by_turn[:3] - hat_of(seen)
    return offset, by_turn


@inlined
def _add_gravity(
    gravity: Array, state: Array, weight: float, information: Array, slope: Array
) -> float:
    """Add the cost of the measured direction: |R g - m|^2 times its precision."""
    precision = weight * gravity[6]
    seen = state[:9].copy().reshape(3, 3) @ gravity[:3]
    error, derivative = seen - gravity[3:6], hat_of(seen)  # a turn phi moves it by seen x phi
    slope[:3] += precision * (derivative.T @ error)
    information[:3, :3] += precision * (derivative.T @ derivative)
    cost: float = precision * np.sum(error * error)
    return cost


# Readout time (s) that is assumed if it is unknown: a slow camera's, whose motion per readout is
# the largest.
_UNKNOWN_READOUT_TIME = 0.03


class TurnSeen(NamedTuple):
    """Speed of a motion as a rotation prior says it."""

    squared_rate: float  # (rad per readout)^2
    variance: float  # of each axis, if the camera is at rest
    typical_variance: float  # of each axis, by the prior of the motion

    def evidence(self, speeds: Array) -> Array:
        """Return the log likelihoods of typical speeds (k,), up to a constant."""
        variances = self.variance + speeds**2 * self.typical_variance
        evidences: Array = -0.5 * (self.squared_rate / variances + 3.0 * np.log(variances))
        return evidences


class Assumed(NamedTuple):
    """Assumptions on a camera and its map, beside the prior of the motion."""

    map_deviation: float  # m
    focal_length: float  # px
    may_rest: bool  # nothing speaks for a motion but the points
    rolling: bool  # velocities are estimated
    lenses: IntArray | None = None  # (k,) camera of each side of a rig; None: one camera
    of_rest: float = 0.0  # logarithm of the odds for rest, beside those of any camera
    of_vibration: Array = np.zeros(0)  # see Prior
    noise: float = math.inf  # px, of its half-normal prior
    turn: TurnSeen | None = None  # by a rotation prior
    in_frame: CoupledTurn | None = None  # likewise


def assumptions(
    span: float, rig: Rig, config: LocalizerConfig, solver: Solver
) -> tuple[PriorTerms, Assumed]:
    """Return the configured assumptions on motion, cameras and map, per span of the row times.

    Args:
        span: s; 0: unknown.
    """
    span = span or _UNKNOWN_READOUT_TIME
    velocity, acceleration = config.velocity_prior, config.acceleration
    if not solver.rolling_shutter:
        terms = held_terms()
    elif config.refinement == RefinementKind.MOTION:
        terms = motion_terms((0.0, 0.0), (_LEAST_DEVIATION, _LEAST_DEVIATION))
    else:
        terms = motion_terms(
            (velocity.angular * span, velocity.linear * span),
            (acceleration.angular * span**2, acceleration.linear * span**2),
        )
    return terms, Assumed(
        map_deviation=config.map_deviation,
        focal_length=rig.focal_length,
        may_rest=solver.rolling_shutter and min(velocity.angular, velocity.linear) > 0.0,
        rolling=solver.rolling_shutter,
    )


def of_frame(
    terms: PriorTerms, assumed: Assumed, prior: Prior | None, rotation: RotationPrior | None
) -> tuple[PriorTerms, Assumed]:
    """Add what is known of this frame: its rotation, rest, vibration, and measurements."""
    if rotation is not None:
        assumed = assumed._replace(turn=turn_seen(terms, rotation))
        informations = terms.informations.copy()
        informations[0][_TURNING] = np.linalg.inv(rotation.error)
        terms = terms._replace(informations=informations)
    if prior is not None:
        assumed = assumed._replace(of_rest=prior.of_rest, of_vibration=prior.of_vibration)
        terms = with_measurements(terms, prior)
    return terms, assumed


def beside(prior: Prior, rotation: RotationPrior) -> Prior:
    """Return a prediction of the whole motion as one of the motion beside a known rotation."""
    assert prior.motion is not None
    assert prior.covariance is not None
    turning, covariance = ROTATION[:6], np.array(prior.covariance)
    covariance[turning] = covariance[:, turning] = 0.0
    covariance[np.ix_(turning, turning)] = rotation.error
    still = replace(prior.motion, angular_velocity=np.zeros(3), angular_acceleration=np.zeros(3))
    return altered(prior, motion=still, covariance=covariance)


def turn_seen(terms: PriorTerms, rotation: RotationPrior) -> TurnSeen:
    """Return the speed by a known rotation, beside the configured prior."""
    variance, rate = sum(rotation.error.diagonal()[:3].tolist()) / 3.0, rotation.smooth_rate
    precision = float(terms.informations[0, ANGULAR.start, ANGULAR.start])
    typical = 1.0 / precision if precision > 0.0 else math.inf
    return TurnSeen(float(rate @ rate), variance, typical)
