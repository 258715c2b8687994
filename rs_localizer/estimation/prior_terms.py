"""Priors as the kernels take them: sums of Gaussians, and the direction of gravity."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.state import (
    ACCELERATIONS,
    ANGULAR,
    ANGULAR_ACCELERATION,
    LINEAR,
    PARAMETERS,
    STATE_ANGULAR,
    STATE_SIZE,
    rotation_of,
)
from rs_localizer.estimation.prior import Prior, state_in

# A precision that holds a velocity at its mean whatever the points say.
_HOLDING = 1e18
# A tenth of the speed goes with the accelerations of the whole.
_JOLTS = 10.0
WALKING = 0.1
"""Least part of the configured linear velocity that goes with a slower turn."""
# What a gyroscope knows: turn rate and its change.
_TURNING = np.ix_(np.r_[ANGULAR, ANGULAR_ACCELERATION], np.r_[ANGULAR, ANGULAR_ACCELERATION])


class PriorTerms(NamedTuple):
    """A prior as the kernels take it: a sum of Gaussians, and a direction."""

    informations: Array  # (k,18,18)
    references: Array  # (k,24) states of their means
    gravity: Array  # (7,) in the map, in the camera, precision


_NO_GRAVITY = np.zeros(7)
_STILL = np.concatenate([np.eye(3).ravel(), np.zeros(STATE_SIZE - 9)])


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
    informations[0, ANGULAR] /= part**2
    informations[0, LINEAR] /= max(part, WALKING) ** 2
    informations[0, ACCELERATIONS] /= min(_JOLTS * part, 1.0) ** 2
    if turn_known:
        informations[0][_TURNING] = terms.informations[0][_TURNING]
    return terms._replace(informations=informations)


def held_beside(terms: PriorTerms, turn_known: bool = False) -> PriorTerms:
    """A camera at rest, of which gravity, and what a gyroscope leaves, are as in other terms."""
    held = held_terms()._replace(gravity=terms.gravity)
    if not turn_known:
        return held
    informations = held.informations.copy()
    informations[0][_TURNING] = terms.informations[0][_TURNING]
    return held._replace(informations=informations)


def terms_at(terms: PriorTerms, speed: float, turn_known: bool) -> PriorTerms:
    """The terms of a typical speed, as a part of the configured one; 0: a camera at rest."""
    if speed == 0.0:
        return held_beside(terms, turn_known)
    return terms if speed == 1.0 else slower_terms(terms, speed, turn_known)


def with_turn(terms: PriorTerms, error: Array) -> PriorTerms:
    """The terms of a motion beside a known turn; error (6,6): see ``KnownTurn.error``."""
    return PriorTerms(_with_turn(terms.informations, error), terms.references, terms.gravity)


@kernel
def _with_turn(informations: Array, error: Array) -> Array:
    changed, precision = informations.copy(), np.linalg.inv(error)
    for i in range(6):
        for j in range(6):
            changed[0, _turning(i), _turning(j)] = precision[i, j]
    return changed


@kernel
def _turning(i: int) -> int:
    """Where a step has the turn rate, and its change six places behind it."""
    place: int = 6 + i + i // 3 * 3
    return place


def gravity_cost(terms: PriorTerms, state: Array) -> float:
    """What a state (24,) costs by the measured direction of gravity, in noise variances."""
    gravity = terms.gravity
    error = rotation_of(state) @ gravity[:3] - gravity[3:6]
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
        reference[STATE_ANGULAR] = prior.angular_velocity
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

    Its term, if it knows anything, is the last one. Beside a known turn it knows the gyroscope's
    errors, too.
    """
    if prior.motion is None or prior.covariance is None:
        return terms
    if np.isinf(np.diagonal(prior.covariance)).all():
        return terms  # the motion is a first guess
    informations, references = _with_motion(
        terms.informations,
        terms.references,
        np.ascontiguousarray(prior.covariance, np.float64),
        state_in(prior.motion, centre),
        turn_known,
    )
    return PriorTerms(informations, references, terms.gravity)


@kernel
def _with_motion(
    informations: Array, references: Array, covariance: Array, reference: Array, turn_known: bool
) -> tuple[Array, Array]:
    count = len(informations)
    found = np.empty((count + 1, PARAMETERS, PARAMETERS))
    of = np.empty((count + 1, STATE_SIZE))
    found[:count], of[:count] = informations, references
    found[count], of[count] = _inverse(covariance), reference
    if len(covariance) == PARAMETERS:  # it knows the accelerations better than a default
        found[0, ACCELERATIONS] = 0.0
        if turn_known:
            for i in range(6):
                for j in range(6):
                    found[0, _turning(i), _turning(j)] = 0.0
    return found, of


@inlined
def _inverse(covariance: Array) -> Array:
    """Information (18,18) of a covariance, zero for parameters of infinite variance."""
    places = np.flatnonzero(np.isfinite(np.diag(covariance)))
    known = len(places)
    block, information = np.empty((known, known)), np.zeros((PARAMETERS, PARAMETERS))
    for i in range(known):
        for j in range(known):
            block[i, j] = covariance[places[i], places[j]]
    inverse = np.linalg.inv(block)
    for i in range(known):
        for j in range(known):
            information[places[i], places[j]] = inverse[i, j]
    return information


def _unit(vector: ArrayLike) -> Array:
    array = np.asarray(vector, float)
    array = array / np.abs(array).max()  # squares of very long vectors overflow
    unit: Array = array / np.linalg.norm(array)
    return unit
