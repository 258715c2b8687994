"""What becomes of Gaussians and of probabilities that are averaged."""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.blocks import write
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.state import PARAMETERS, TURN, step_between
from rs_localizer.estimation.curvature import told_from
from rs_localizer.estimation.refine import apply_step

# Probabilities that have no part in the covariance.
_NO_PART = 1e-5


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
def longest_axis(covariance: Array) -> float:
    """Standard deviation (rad) of the turn about the axis that is known worst."""
    return math.sqrt(np.linalg.eigvalsh(covariance[:3, :3].copy())[-1])


def warm_up() -> None:
    """Compile what planes come to that show two poses."""
    longest_axis(np.eye(PARAMETERS))
