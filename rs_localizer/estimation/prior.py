"""What is known of the motion before the image: Gaussian priors and the direction of gravity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.core.arrays import Array
from rs_localizer.core.lanes.jit import kernel
from rs_localizer.core.shutter import Motion
from rs_localizer.core.so3 import log
from rs_localizer.core.state import (
    ACCELERATIONS,
    ANGULAR,
    ANGULAR_ACCELERATION,
    LINEAR,
    MOTION_PARAMETERS,
    PARAMETERS,
    STATE_SIZE,
)

# A precision that holds a velocity at its mean whatever the points say.
_HOLDING = 1e18
_LEAST_DEVIATION = 1e-9
# A tenth of the speed goes with the accelerations of the whole.
_JOLTS = 10.0
_WALKING = 0.1
# What a gyroscope knows: turn rate and its change.
_TURNING = np.ix_(np.r_[ANGULAR, ANGULAR_ACCELERATION], np.r_[ANGULAR, ANGULAR_ACCELERATION])
# Numbers whose squares are finite.
_MOST = 1e100


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What else is known of one frame; give any of the three.

    Args:
        motion, covariance: expected motion and its (12,12) covariance, in the order of
            ``Estimate.covariance``, or (18,18) with its accelerations, in the order of
            ``Estimate.joint_covariance``; infinite variances leave a parameter free.
        angular_velocity, angular_velocity_deviation: a gyroscope's body rate (3,) in camera axes
            times the readout time (rad per readout), and its standard deviation.
        of_shake_sizes, of_field_sizes: what the frames before say of shaking and model error, as
            the fields of ``Estimate`` of these names.
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
    of_shake_sizes: Array | None = None
    of_field_sizes: Array | None = None

    def __post_init__(self) -> None:
        if (self.motion is None) != (self.covariance is None):
            raise ValueError("a prior motion and its covariance go together")
        if self.motion is not None and self.covariance is not None:
            _check_motion(self.motion)
            _check_covariance(np.asarray(self.covariance, float))
        for name in ("angular_velocity", "gravity", "gravity_in_map"):
            vector = getattr(self, name)
            if vector is None:
                continue
            array = np.array(vector, dtype=np.float64)
            if array.shape != (3,) or not np.all(np.isfinite(array)):
                raise ValueError(f"{name} must be three finite numbers, got {vector!r}")
            if name != "angular_velocity" and not np.abs(array).max() > 0.0:
                raise ValueError(f"{name} has no direction: {vector!r}")
            deviation = getattr(self, f"{name}_deviation", 1.0)
            if not _LEAST_DEVIATION <= deviation < math.inf:
                raise ValueError(
                    f"{name}_deviation must be at least {_LEAST_DEVIATION:g} and finite, "
                    f"got {deviation}"
                )


class PriorTerms(NamedTuple):
    """A prior as the kernels take it: a sum of Gaussians, and a direction."""

    informations: Array  # (k,18,18)
    references: Array  # (k,24) states of their means
    gravity: Array  # (7,) in the map, in the camera, precision


_NO_GRAVITY = np.zeros(7)
_STILL = np.concatenate([np.eye(3).ravel(), np.zeros(STATE_SIZE - 9)])


def _check_motion(motion: Motion) -> None:
    for name in (
        "rotation", "translation", "angular_velocity", "linear_velocity",
        "angular_acceleration", "linear_acceleration",
    ):  # fmt: skip
        shape = (3, 3) if name == "rotation" else (3,)
        if np.shape(getattr(motion, name)) != shape:
            raise ValueError(
                f"the prior motion's {name} must be of shape {shape}, "
                f"got {np.shape(getattr(motion, name))}"
            )
        if not np.all(np.abs(getattr(motion, name)) < _MOST):
            raise ValueError(f"the prior motion's {name} is not finite: {getattr(motion, name)}")
    rotation = np.asarray(motion.rotation)
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if off > 1e-6 or np.linalg.det(rotation) < 0.0:
        raise ValueError(f"the prior motion's rotation is none: {rotation.tolist()}")


def _check_covariance(covariance: Array) -> None:
    if covariance.shape not in ((MOTION_PARAMETERS,) * 2, (PARAMETERS,) * 2):
        raise ValueError(f"covariance must be (12,12) or (18,18), got {covariance.shape}")
    known = ~np.isinf(np.diag(covariance))
    if not np.any(known):
        return  # everything is free: the motion is only a first guess
    block = covariance[np.ix_(known, known)]
    if not np.all(np.isfinite(block)):
        raise ValueError("covariance must be finite where its diagonal is")
    scale = np.sqrt(np.abs(np.diag(block)))
    if not np.all(np.abs(block - block.T) <= 1e-6 * np.outer(scale, scale)):
        raise ValueError("covariance must be symmetric")
    if not np.all(scale > 0.0) or np.linalg.eigvalsh(block / np.outer(scale, scale))[0] < 1e-12:
        raise ValueError("covariance must be positive definite")


def motion_terms(velocities: Sequence[float], accelerations: Sequence[float]) -> PriorTerms:
    """Zero-mean prior of these standard deviations, each angular and linear; 0: none.

    Args:
        velocities: rad and m per readout.
        accelerations: rad and m per readout squared.
    """
    precisions = [0.0 if d == 0.0 else d**-2 for d in (*velocities, *accelerations)]
    return _single(np.diag(np.concatenate([np.zeros(6), np.repeat(precisions, 3)])), _STILL)


@cache
def held_terms() -> PriorTerms:
    """A global shutter: velocities and accelerations are zero."""
    return _single(np.diag(np.concatenate([np.zeros(6), np.full(12, _HOLDING)])), _STILL)


def slower_terms(terms: PriorTerms, part: float, turn_known: bool = False) -> PriorTerms:
    """The prior of a motion whose typical turn rate is this part of the configured one.

    Neither travel nor accelerations slow down as much: who hardly turns may walk, and jolts come
    at any speed. What a gyroscope leaves of a turn does not depend on it.
    """
    informations = terms.informations.copy()
    kept = informations[0][_TURNING].copy()
    informations[0, ANGULAR] /= part**2
    informations[0, LINEAR] /= max(part, _WALKING) ** 2
    informations[0, ACCELERATIONS] /= min(_JOLTS * part, 1.0) ** 2
    if turn_known:
        informations[0][_TURNING] = kept
    return terms._replace(informations=informations)


def held_beside(terms: PriorTerms, turn_known: bool = False) -> PriorTerms:
    """A camera at rest, of which gravity, and what a gyroscope leaves, are as in other terms."""
    held = held_terms()._replace(gravity=terms.gravity)
    if not turn_known:
        return held
    informations = held.informations.copy()
    informations[0][_TURNING] = terms.informations[0][_TURNING]
    return held._replace(informations=informations)


def with_turn(terms: PriorTerms, error: Array) -> PriorTerms:
    """The terms of a motion beside a known turn; error (6,6): see ``KnownTurn.error``."""
    informations = terms.informations.copy()
    informations[0][_TURNING] = np.linalg.inv(error)
    return terms._replace(informations=informations)


def gravity_cost(terms: PriorTerms, state: Array) -> float:
    """What a state (24,) costs by the measured direction of gravity, in noise variances."""
    gravity = terms.gravity
    error = state[:9].reshape(3, 3) @ gravity[:3] - gravity[3:6]
    return float(gravity[6] * (error @ error))


def _single(information: Array, reference: Array) -> PriorTerms:
    return PriorTerms(information[None], reference[None].copy(), _NO_GRAVITY)


def with_measurements(terms: PriorTerms, prior: Prior) -> PriorTerms:
    """The terms and what a prior says but for the motion: angular velocity and gravity."""
    informations, references, gravity = terms
    if prior.angular_velocity is not None:
        information = np.zeros((PARAMETERS, PARAMETERS))
        information[ANGULAR, ANGULAR] = np.eye(3) / prior.angular_velocity_deviation**2
        reference = _STILL.copy()
        reference[12:15] = prior.angular_velocity
        informations = np.concatenate([informations, information[None]])
        references = np.concatenate([references, reference[None]])
    if prior.gravity is not None:
        gravity = np.concatenate(
            [
                _unit(prior.gravity_in_map),
                _unit(prior.gravity),
                [prior.gravity_deviation**-2],
            ]
        )
    return PriorTerms(informations, references, gravity)


def with_motion(
    terms: PriorTerms, prior: Prior, centre: Array, turn_known: bool = False
) -> PriorTerms:
    """The terms and a prior's motion in the map frame, for points relative to ``centre`` (3,).

    Its term is the last one. Beside a known turn it knows the gyroscope's errors, too.
    """
    if prior.motion is None or prior.covariance is None:
        return terms
    own = terms.informations
    if len(prior.covariance) == PARAMETERS:  # it knows the accelerations better than a default
        own = own.copy()
        own[0, ACCELERATIONS] = 0.0
        if turn_known:
            own[0][_TURNING] = 0.0
    return PriorTerms(
        np.concatenate([own, _inverse(np.asarray(prior.covariance, float))[None]]),
        np.concatenate([terms.references, state_in(prior.motion, centre)[None]]),
        terms.gravity,
    )


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


def _unit(vector: ArrayLike) -> Array:
    array = np.asarray(vector, float)
    array = array / np.abs(array).max()  # squares of very long vectors overflow
    unit: Array = array / np.linalg.norm(array)
    return unit


def _inverse(covariance: Array) -> Array:
    """Information (18,18) of a covariance, zero for parameters of infinite variance."""
    information = np.zeros((PARAMETERS, PARAMETERS))
    known = np.flatnonzero(np.isfinite(np.diag(covariance)))
    block = np.ix_(known, known)
    information[block] = np.linalg.inv(covariance[block])
    return information


@kernel
def add_prior(
    informations: Array,
    references: Array,
    gravity: Array,
    state: Array,
    weight: float,
    information: Array,
    slope: Array,
) -> float:
    """Add the prior's part, times ``weight``, to the normal equations; returns its cost.

    These are of all 18 parameters, or of the first 12, while the accelerations are what they are.
    """
    cost = 0.0
    size = len(slope)
    offset = np.empty(PARAMETERS)
    pulled = np.empty(PARAMETERS)
    # Derivative of the offset by a step: identity but for the rotation and position blocks.
    by_turn, by_move = np.empty((3, 3)), np.empty((3, 3))
    for term in range(len(informations)):
        prior, reference = informations[term], references[term]
        posed = (
            prior[0, 0] + prior[1, 1] + prior[2, 2] + prior[3, 3] + prior[4, 4] + prior[5, 5] > 0
        )
        first = 0 if posed else 6
        for i in range(6):
            offset[i] = 0.0
        for i in range(6, PARAMETERS):
            offset[i] = state[6 + i] - reference[6 + i]
        if posed:
            _pose_offset(state, reference, offset, by_turn, by_move)
        for i in range(first, PARAMETERS):
            total = 0.0
            for j in range(first, PARAMETERS):
                total += prior[i, j] * offset[j]
            pulled[i] = weight * total
            cost += offset[i] * pulled[i]
        if not posed:
            for i in range(6, size):
                slope[i] += pulled[i]
                for j in range(6, size):
                    information[i, j] += weight * prior[i, j]
            continue
        _add_posed(prior, pulled, by_turn, by_move, weight, information, slope)
    if gravity[6] > 0.0:
        cost += _add_gravity(gravity, state, weight, information, slope)
    return cost


@kernel
def _add_posed(
    prior: Array,
    pulled: Array,
    by_turn: Array,
    by_move: Array,
    weight: float,
    information: Array,
    slope: Array,
) -> None:
    """Add J^T P J and J^T p, where J is the identity but for the blocks of turn and move."""
    size = len(slope)
    half = prior.copy()  # P J
    for i in range(size):
        for j in range(3):
            turned, moved = 0.0, 0.0
            for k in range(3):
                turned += prior[i, k] * by_turn[k, j]
                moved += prior[i, 3 + k] * by_move[k, j]
            half[i, j], half[i, 3 + j] = turned, moved
    for i in range(3):
        for j in range(size):
            turned, moved = 0.0, 0.0
            for k in range(3):
                turned += by_turn[k, i] * half[k, j]
                moved += by_move[k, i] * half[3 + k, j]
            information[i, j] += weight * turned
            information[3 + i, j] += weight * moved
        turned, moved = 0.0, 0.0
        for k in range(3):
            turned += by_turn[k, i] * pulled[k]
            moved += by_move[k, i] * pulled[3 + k]
        slope[i] += turned
        slope[3 + i] += moved
    for i in range(6, size):
        slope[i] += pulled[i]
        for j in range(size):
            information[i, j] += weight * half[i, j]


@kernel
def _pose_offset(
    state: Array, reference: Array, offset: Array, by_turn: Array, by_move: Array
) -> None:
    """The step (turn, move) from the reference pose to the state's and its derivatives."""
    relative = np.empty((3, 3))  # reference from state: exp([turn]x)
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += reference[3 * i + k] * state[3 * j + k]
            relative[i, j] = total
            by_move[i, j] = total
    turn = log(relative)
    x, y, z = turn[0], turn[1], turn[2]
    squared = x * x + y * y + z * z
    angle = np.sqrt(squared)
    # Inverse right Jacobian of the exponential; its second coefficient is 1/12 at zero.
    if angle < 1e-3:
        second = 1.0 / 12.0
    else:
        second = (1.0 - 0.5 * angle * np.sin(angle) / (1.0 - np.cos(angle))) / squared
    by_turn[0, 0] = 1.0 - second * (y * y + z * z)
    by_turn[1, 1] = 1.0 - second * (x * x + z * z)
    by_turn[2, 2] = 1.0 - second * (x * x + y * y)
    by_turn[0, 1], by_turn[1, 0] = -0.5 * z + second * x * y, 0.5 * z + second * x * y
    by_turn[0, 2], by_turn[2, 0] = 0.5 * y + second * x * z, -0.5 * y + second * x * z
    by_turn[1, 2], by_turn[2, 1] = -0.5 * x + second * y * z, 0.5 * x + second * y * z
    for i in range(3):
        offset[i] = turn[i]
        moved = 0.0
        for j in range(3):
            moved += relative[i, j] * state[9 + j]
        offset[3 + i] = reference[9 + i] - moved


@kernel
def _add_gravity(
    gravity: Array, state: Array, weight: float, information: Array, slope: Array
) -> float:
    """Part of the measured direction: |R g - m|^2 times its precision."""
    precision = weight * gravity[6]
    seen = np.empty(3)
    for i in range(3):
        total = 0.0
        for j in range(3):
            total += state[3 * i + j] * gravity[j]
        seen[i] = total
    # A turn phi of the camera moves the direction by seen x phi.
    derivative = np.zeros((3, 3))
    derivative[0, 1], derivative[0, 2] = -seen[2], seen[1]
    derivative[1, 0], derivative[1, 2] = seen[2], -seen[0]
    derivative[2, 0], derivative[2, 1] = -seen[1], seen[0]
    cost = 0.0
    for k in range(3):
        error = seen[k] - gravity[3 + k]
        cost += precision * error * error
        for i in range(3):
            slope[i] += precision * derivative[k, i] * error
            for j in range(3):
                information[i, j] += precision * derivative[k, i] * derivative[k, j]
    return cost
