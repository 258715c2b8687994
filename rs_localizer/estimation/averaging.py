"""What becomes of Gaussians and of probabilities that are averaged."""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.blocks import write
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.state import PARAMETERS, STATE_SIZE, TURN, step_between
from rs_localizer.estimation.curvature import told_from
from rs_localizer.estimation.model_error import Examined
from rs_localizer.estimation.prior_terms import PriorTerms
from rs_localizer.estimation.refine import apply_step, solve_positive

_LEAST_PROBABLE = 1e-200  # of which there still is a logarithm
# Probabilities that have no part in the covariance.
_NO_PART = 1e-5
# Squared distance, in variances, of what is the same; and of what ends in the same place.
_ALIKE, _ON_THE_WAY = 1e-4, 1.0


@kernel
def averaged(
    states: Array, covariances: Array, best: int, counting: Array, possible: Array
) -> tuple[Array, Array, Array]:
    """Mean (24,) of Gaussians by the ones probabilities (k,), covariance (18,18) by the others.

    And the steps (k,18) from the best one to all.
    """
    count = len(states)
    steps, mean = np.empty((count, PARAMETERS)), np.empty(PARAMETERS)
    for k in range(count):
        write(steps[k], step_between(states[best], states[k]))
    for i in range(PARAMETERS):
        total = 0.0
        for k in range(count):
            total += counting[k] * steps[k, i]
        mean[i] = total
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    for k in range(count):
        offset = steps[k] - mean
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                covariance[i, j] += possible[k] * offset[i] * offset[j]
        if possible[k] > _NO_PART:
            covariance += possible[k] * told_from(covariances[k], offset[TURN])
    return apply_step(states[best], mean), covariance, steps


@kernel
def alike(state: Array, other: Array, covariance: Array) -> bool:
    """Whether two states are nothing but steps that a fit left out apart, beside a covariance."""
    step = step_between(state, other)
    for part in range(0, PARAMETERS, 3):
        squared, spread = 0.0, 0.0
        for k in range(part, part + 3):
            squared += step[k] * step[k]
            spread += covariance[k, k]
        if not squared <= _ALIKE * spread:
            return False
    return True


@kernel
def on_the_way(state: Array, other: Array, covariance: Array) -> bool:
    """Whether a state is so near another one, the best of those around, that it would end there."""
    step = step_between(state, other)
    solution, solved = solve_positive(covariance, step)
    return bool(solved and np.sum(step * solution) < _ON_THE_WAY)


def warm_up() -> None:
    """Compile what a frame comes to of which another motion is as good."""
    on_the_way(np.zeros(STATE_SIZE), np.zeros(STATE_SIZE), np.eye(PARAMETERS))


@kernel
def more_probable(prior: Array, odds: Array) -> Array:
    # Frames may be so sure together that the rest vanishes, but nothing is impossible.
    return np.maximum(normalized(np.log(prior) + odds), _LEAST_PROBABLE)


@kernel
def normalized(evidence: Array) -> Array:
    weights = np.exp(evidence - evidence.max())
    normalized: Array = weights / weights.sum()
    return normalized


def volume_of(terms: PriorTerms, examined: Examined) -> float:
    """The part of the evidence that speaks for few possibilities of the motion."""
    return 0.5 * (_known(terms.informations[0]) - examined.determined)


@kernel
def _known(information: Array) -> float:
    """Logarithm of the determinant of what a prior knows, of no two parameters together."""
    total = 0.0
    for k in range(len(information)):
        if information[k, k] > 0.0:
            total += np.log(information[k, k])
    return total


@kernel
def longest_axis(covariance: Array) -> float:
    """Standard deviation (rad) of the turn about the axis that is known worst."""
    return math.sqrt(np.linalg.eigvalsh(covariance[:3, :3].copy())[-1])
