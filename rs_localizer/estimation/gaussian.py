# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Gaussians about motions, and their one mixture.

The points say precisely in which direction they are and roughly how far away. A camera whose
orientation they hardly tell is somewhere on an arc about them, and arcs leave their tangents: by
half of 3 m times the square of 4 degrees, 7 mm, where the ellipsoid is thinner than 1 mm. In the
terms of a step (turn ``phi``, move ``rho``; see :mod:`rs_localizer.estimation.robust`), points at
``p`` in camera axes that move there by ``d`` are seen from

    rho = p - exp([phi]x) (p + d)
        = -d - phi x p - (phi x (phi x p) / 2 + phi x d) - ...

of which the ellipsoid has the first two. Arcs also turn the axes: a step from one point of an arc,
told from another one, moves along other axes. So motions differ by offsets about the middle of the
points, where arcs are straight (:func:`rs_localizer.estimation.prior.offset_between`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, Array3
from rs_localizer.core.so3 import hat
from rs_localizer.core.state import MOVE, PARAMETERS, STATE_TRANSLATION, TURN
from rs_localizer.estimation.prior import offset_between
from rs_localizer.estimation.robust import apply_step
from rs_localizer.native import entry

# Of y = (phi, d): d = -rho + [p]x phi by p; the forms of -phi x d, and of -phi x (phi x p) / 2 =
# (p (phi . phi) - phi (phi . p)) / 2 by p.
_BY_STEP, _BY_CENTRE = np.diag(np.repeat([1.0, -1.0], 3)), np.zeros((3, 6, 6))
_CROSSES, _TWICE_CROSSED = np.zeros((3, 6, 6)), np.zeros((3, 3, 6, 6))
_UNIT = np.eye(3)
_BY_CENTRE[:, MOVE, TURN] = hat(_UNIT)
_CROSSES[:, TURN, MOVE], _CROSSES[:, MOVE, TURN] = 0.5 * hat(_UNIT), -0.5 * hat(_UNIT)
_SQUARES = 0.5 * _UNIT[:, :, None, None] * _UNIT
_OUTER = _UNIT[None, :, :, None] * _UNIT[:, None, None]  # p_c phi_i phi_c
_TWICE_CROSSED[:, :, TURN, TURN] = _SQUARES - 0.25 * (_OUTER + _OUTER.transpose(0, 1, 3, 2))


class Gaussians(NamedTuple):
    """Gaussians about motions, each with its evidence.

    Behind the 18 numbers of a step covariances may have those of an in-frame turn.
    """

    states: Array  # (k,24)
    turns: Array  # (k,t) coefficients of the in-frame turn
    covariances: Array  # (k,18 + t,18 + t)
    evidences: Array  # (k,) logarithms


class Mixture(NamedTuple):
    """Gaussians as one."""

    state: Array  # (24,)
    turn: Array  # (t,)
    covariance: Array  # (18 + t,18 + t)
    evidence: float  # logarithm of the sum
    probable: Array  # (k,) weights in the mean
    possible: Array  # (k,) weights in the covariance
    offsets: Array  # (k,18) from the mean
    covariances: Array  # (k,18,18) of the offsets

    def along_arcs(self) -> Array:
        """Return the covariance (18,18) of steps, of second order (:func:`along_arcs`)."""
        covariance, centre = (
            self.covariance[:PARAMETERS, :PARAMETERS],
            self.state[STATE_TRANSLATION],
        )
        return along_arcs(
            np.ascontiguousarray(covariance), centre, self.possible, self.offsets,
            np.ascontiguousarray(self.covariances),
        )  # fmt: skip


@entry
def moments(means: Array2, covariances: Array3, weights: Array1) -> Array:
    """Return second moments (p,p) about zero of Gaussians (k,p), (k,p,p) with weights (k,)."""
    size = means.shape[1]
    total = np.zeros((size, size))
    for k in range(len(weights)):
        if weights[k] > 0.0:
            mean = means[k]
            for i in range(size):
                for j in range(size):
                    total[i, j] += weights[k] * (covariances[k, i, j] + mean[i] * mean[j])
    return total


def weights_of(logarithms: Array) -> Array:
    """Return the probabilities (k,) with these logarithms, up to a constant."""
    weights = np.exp(logarithms - logarithms.max())
    found: Array = weights / weights.sum()
    return found


def mixture(parts: Gaussians, preferences: Array, temper: float) -> Mixture:
    """Return the mixture of Gaussians, with the mean by their probabilities, second moments
    about it by probabilities to the power of ``temper``.

    Args:
        preferences: (k,) logarithms of odds that count in the mean alone.
    """
    if len(parts.states) == 1:
        one = parts.covariances[0]
        return Mixture(
            parts.states[0], parts.turns[0], one, float(parts.evidences[0]), np.ones(1), np.ones(1),
            np.zeros((1, PARAMETERS)), one[None, :PARAMETERS, :PARAMETERS],
        )  # fmt: skip
    probable = weights_of(parts.evidences + preferences)
    possible = weights_of(temper * parts.evidences)
    top = parts.evidences.max()
    evidence = float(top + np.log(np.exp(parts.evidences - top).sum()))
    best = int(probable.argmax())
    first, turn = (
        parts.states[best],
        parts.turns[best] + probable @ (parts.turns - parts.turns[best]),
    )
    pivot = first[STATE_TRANSLATION]
    steps, _ = _offsets_between(first, parts.states, pivot)
    mean = probable @ steps
    state = apply_step(first, mean)
    # About the pivot, which the move of a step is not.
    state[STATE_TRANSLATION] = pivot - mean[MOVE] + hat(pivot) @ mean[TURN]
    pivot = state[STATE_TRANSLATION].copy()
    offsets, by_turns = _offsets_between(state, parts.states, pivot)
    # Covariances of steps as those of offsets, which go with the turn.
    by_step = np.zeros((len(by_turns), 6, 6))
    by_step[:, :, :3], by_step[:, 3:, 3:] = by_turns, np.eye(3)
    about = parts.covariances.copy()
    about[:, :6] = by_step @ about[:, :6]
    about[:, :, :6] = about[:, :, :6] @ by_step.transpose(0, 2, 1)
    away = np.hstack([offsets, parts.turns - turn])
    covariance = moments(away, about, possible)
    about = about[:, :PARAMETERS, :PARAMETERS]
    return Mixture(state, turn, covariance, evidence, probable, possible, offsets, about)


@entry
def _offsets_between(reference: Array1, states: Array2, pivot: Array1) -> tuple[Array, Array]:
    """Return :func:`offset_between` of states (k,24): offsets (k,18), derivatives (k,6,3)."""
    count = len(states)
    offsets, by_turns = np.empty((count, PARAMETERS)), np.empty((count, 6, 3))
    for k in range(count):
        offsets[k], by_turns[k] = offset_between(reference, states[k], pivot)
    return offsets, by_turns


def along_arcs(
    covariance: Array, centre: Array, weights: Array, offsets: Array, covariances: Array
) -> Array:
    """Return the covariance to second order in the move; the rotation has no second order.

    The second order of a mixture is not that of one Gaussian: a hypothesis that rotated by three
    deviations moved nine times as far off the tangent as one that rotated by one. The mean stays
    where the points fit best, so that the mean of the second order counts, too. Let ``s_i = y^T H_i
    y`` for Gaussians ``y`` with mean ``m`` and covariance ``C``. Then ``E[s_i]`` is ``tr(H_i C) +
    m^T H_i m``, and ``E[y s_i]`` is ``m E[s_i] + 2 C H_i m``. The mean of ``s_i s_j`` is ``E[s_i]
    E[s_j] + 2 tr(H_i C H_j C) + 4 m^T H_i C H_j m``.

    Args:
        covariance: (18,18), of a step.
        centre: (3,) of the points, in camera axes.
        weights: (k,) of Gaussians whose mixture it is.
        offsets: (k,18) of their means (:func:`offset_between`).
        covariances: (k,18,18) of the offsets.
    """
    # y = (phi, d): d = -rho + [p]x phi.
    by_step = _BY_STEP + (centre @ _BY_CENTRE.reshape(3, -1)).reshape(6, 6)
    forms = _CROSSES + (centre @ _TWICE_CROSSED.reshape(3, -1)).reshape(3, 6, 6)
    count = len(weights)
    means, crossed = offsets[:, :6] @ by_step.T, covariances[:, :, :6] @ by_step.T
    both = by_step @ crossed[:, :6]
    products, pulls = forms @ both[:, None], (forms @ means[:, None, :, None])[..., 0]
    size = np.trace(products, axis1=2, axis2=3) + (pulls @ means[:, :, None])[..., 0]
    second = size[:, :, None] * size[:, None] + 4.0 * pulls @ both @ pulls.transpose(0, 2, 1)
    crossings = products.transpose(0, 1, 3, 2).reshape(count, 3, 36).transpose(0, 2, 1)
    second += 2.0 * products.reshape(count, 3, 36) @ crossings
    first = size[:, :, None] * offsets[:, None] + 2.0 * pulls @ crossed.transpose(0, 2, 1)
    farther, along = covariance.copy(), (weights @ first.reshape(count, -1)).reshape(3, -1)
    farther[MOVE, MOVE] += (weights @ second.reshape(count, -1)).reshape(3, 3)
    farther[MOVE] += along
    farther[:, MOVE] += along.T
    return farther
