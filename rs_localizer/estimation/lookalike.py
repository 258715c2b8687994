"""Frames of a plane that look as if the camera rests: regions that hold for who moves, too.

A camera that moves before a small plane may see, within the noise, what a resting one sees before a
plane of another lean. Of all cameras together the posterior is right to believe in rest: hardly
one frame of one that moves looks like that, and every frame of one at rest does. But a user has one
camera, and the region of rest is thin beside its longest turn: of the moving ones among them every
second pose was outside. So the region is widened until it holds the fastest motion that the points
allow (a minimax in place of a mean). The longest turn stays what the posterior has: it is long
anyway, and decides whether a pose is published.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.state import ACCELERATIONS, PARAMETERS, TURN, step_between
from rs_localizer.estimation.averaging import longest_axis
from rs_localizer.estimation.curvature import told_from
from rs_localizer.estimation.modes import Mode

# Noise variances within which rest explains the points as well as any motion: a camera at rest
# exceeds them once in forty frames.
_AS_WELL = 10.0
# Second moments of the motion that the region holds, times this: motions that look like rest are at
# the edge of what motions do, and the valley is curved.
_TIMES = 3.0
_ROUNDS = 3  # one for each axis of a turn


def holding_motion(modes: list[Mode], state: Array, covariance: Array) -> Array:
    """The covariance (18,18) about a state (24,), made to hold the fastest of the motions, too.

    It stays as it is where rest does not explain the points as well.
    """
    least = min(mode.cost for mode in modes) + _AS_WELL
    speed = max(mode.speed for mode in modes)
    if speed == 0.0 or not any(mode.speed == 0.0 and mode.cost < least for mode in modes):
        return covariance
    farthest, held = 0.0, None
    for mode in modes:
        if mode.speed == speed and mode.cost < least:
            moment = _second_moment(mode.covariance, step_between(state, mode.state))
            turn = longest_axis(moment)
            if turn > farthest:
                farthest, held = turn, moment
    if held is None or not np.all(np.isfinite(covariance)):
        return covariance
    wider: Array = _widened(covariance, _TIMES * held)
    return wider


def warm_up() -> None:
    """Compile what a plane needs that looks like rest."""
    moment = _second_moment(np.eye(PARAMETERS), np.zeros(PARAMETERS))
    longest_axis(moment)
    _widened(np.eye(PARAMETERS), moment)


def _second_moment(covariance: Array, step: Array) -> Array:
    """Of pose and velocities of a Gaussian (18,18) that is a step (18,) away."""
    second: Array = told_from(covariance, step[TURN]) + np.outer(step, step)
    second[ACCELERATIONS], second[:, ACCELERATIONS] = 0.0, 0.0
    return second


@kernel
def _widened(covariance: Array, more: Array) -> Array:
    """A covariance (18,18) and another one, but for what makes the longest turn longer."""
    longest = longest_axis(covariance) ** 2
    for _ in range(_ROUNDS):
        variances, axes = np.linalg.eigh(covariance[TURN, TURN] + more[TURN, TURN])
        along, own = np.zeros(PARAMETERS), 0.0
        for k in range(3):
            along += axes[k, 2] * more[k]
        for k in range(3):
            own += along[k] * axes[k, 2]
        if not (variances[2] > longest and own > 0.0):
            break
        # What is left has so much less variance about this axis, and no negative one about any.
        less = min((variances[2] - longest) / own, 1.0) / own
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                more[i, j] -= less * along[i] * along[j]
    return covariance + more
