# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The way from a posterior to what users get, the delay of a known turn among it.

A turn that comes too early by ``d`` turns each row by too much, or too little; where the camera
vibrates, no motion under constant acceleration looks like that, and a single frame tells the delay
to a tenth of a millisecond. The phase of a vibration is lost at once, however, so delays are tried
one by one. Near the motion, with the derivatives ``J`` of the errors ``e`` by it and ``B`` by a
turn of each row, a delay that turns the rows by ``phi`` leaves of them, by the motion that is best
beside it,

    |e + B phi|^2 - g^T (J^T J)^-1 g,   g = J^T (e + B phi)

Nothing else is supposed of the motion: what is known of it may come from the turn.
"""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.arrays import Array, Array2, Array3
from rs_localizer.core.gyro_rotation import GyroRotation
from rs_localizer.core.rate_spline import multiplied
from rs_localizer.core.reasons import Reason
from rs_localizer.core.so3 import log
from rs_localizer.core.state import (
    ANGULAR,
    LINEAR,
    MOTION_PARAMETERS,
    PARAMETERS,
    POSE,
    POSE_SIZE,
    STATE_ANGULAR,
    STATE_ANGULAR_ACCELERATION,
    STATE_LINEAR,
    STATE_LINEAR_ACCELERATION,
    STATE_TRANSLATION,
    rotation_of,
)
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.calibration import CalibrationEffect
from rs_localizer.estimation.gaussian import along_arcs
from rs_localizer.estimation.observations import Observations, Observed
from rs_localizer.estimation.posterior import Posterior
from rs_localizer.estimation.refine import TINY
from rs_localizer.estimation.residuals import linearized
from rs_localizer.native import entry

# Turns (rad) that are not worth the time: a tenth of what a good frame tells of its pose.
_LEAST_TURN = 3e-5
# Delays to try, in standard deviations and readouts: a vibration of four cycles per readout turns
# by a seventh of its cycle from one to the next.
_FARTHEST, _NEAREST, _STEP = 3.0, 2.0, 1.0 / 60.0
# What another delay has to cost beyond the best one (noise variances), at this distance from it
# (steps), for that to be believed.
_CLEARLY, _OTHER = 12.0, 3
# Of a velocity so large a part may be its deviation: it is 0.5 to 1.5 of the true one then.
_TOLD = 0.5
# Probability of rest (in a covariance), beyond which the velocities are none.
_CERTAIN = 0.95


def delay_of(
    observations: Observations, posterior: Posterior, turn: GyroRotation
) -> tuple[float, float]:
    """Delay (readouts) that the known turn needs, and the variance of that.

    An infinite variance says that it is not known, or that it is beyond what was tried.
    """
    unknown = 0.0, math.inf
    if turn.roughness * min(turn.delay, _STEP) < _LEAST_TURN:
        return unknown
    count = math.ceil(_FARTHEST * turn.delay / _STEP) if turn.delay > _STEP / _FARTHEST else 1
    step = min(_FARTHEST * turn.delay / count, _STEP)
    # As far as there are samples. Where the right one may lie beyond, another might look right.
    count = min(count, int(min(-0.5 - turn.tau[0], turn.tau[-1] - 0.5) / step))
    if count < 1 or count * step < _NEAREST * turn.delay:
        return unknown
    delays = step * np.arange(-count, count + 1, dtype=np.float64)
    costs = _costs(observations, posterior, turn, delays)
    best = int(np.argmin(costs))
    if not 0 < best < len(costs) - 1:
        if count > 1:
            beyond = costs[best] < costs[count] - _CLEARLY
            return (float(delays[best]), math.inf) if beyond else unknown
        best = 1
    bend = float(costs[best - 1] - 2.0 * costs[best] + costs[best + 1])
    far = np.abs(np.arange(len(costs)) - best) > _OTHER
    if not bend > 0.0 or np.any(costs[far] < costs[best] + _CLEARLY):
        return unknown
    shift = 0.5 * step * float(costs[best - 1] - costs[best + 1]) / bend
    return float(delays[best]) + shift, 2.0 * step**2 / bend


def _costs(
    observations: Observations, posterior: Posterior, turn: GyroRotation, delays: Array
) -> Array:
    """Costs of delays (k,), in noise variances."""
    count = observations.count
    errors, by_motion, by_turn, tau, _ = linearized(
        observations.packed,
        count,
        posterior.state,
        np.zeros((count, 6)),
    )
    inliers = posterior.inliers & np.isfinite(observations.squared_errors(posterior.state))
    free = by_motion[inliers].reshape(-1, PARAMETERS)
    scale = np.sqrt(np.einsum("ni,ni->i", free, free)) + TINY
    base, _ = np.linalg.qr(free / scale)
    shown, _ = turn.at_rows(tau)
    middles, _ = turn.at_rows(-delays)
    costs = np.empty(len(delays))
    for k, delay in enumerate(delays):
        rotations, _ = turn.at_rows(tau - delay)
        turned = _turned(errors, by_turn, shown, rotations, middles[k])[inliers].ravel()
        along = turned @ base
        costs[k] = turned @ turned - along @ along
    freedom = max(len(free) - PARAMETERS, 1)
    # Where no delay is right, their scatter is no smaller than what the best one leaves.
    return costs / max(posterior.noise**2, float(costs.min()) / freedom)


@entry
def _turned(
    errors: Array2, by_turn: Array3, shown: Array3, rotations: Array3, middle: Array2
) -> Array:
    """Errors (n,2) px with the rows turned as in ``rotations``, not as they are shown."""
    turned = np.empty_like(errors)
    back = middle.T.copy()
    for i in range(len(errors)):
        # Of the compensated camera: from the turn that it was compensated by to the delayed one.
        delayed = multiplied(rotations[i], back)
        phi = log(multiplied(delayed.T.copy(), shown[i]))
        for row in range(2):
            turned[i, row] = errors[i, row]
            for k in range(3):
                turned[i, row] += by_turn[i, row, k] * phi[k]
    return turned


def sample_estimate(
    observed: Observed, state: Array, samples: int, threshold: float, fewest: int
) -> Estimate | Failure:
    """The estimate of a minimal sample's model as it is, without a covariance.

    Args:
        state: (24,) of the model.
        samples: minimal samples drawn.
        threshold: px, of inliers.
        fewest: inliers of an accepted pose.
    """
    usable, rotation = observed.sighted.usable, rotation_of(state)
    residuals = np.full(len(observed.sighted.points), np.nan)
    residuals[usable.indices] = np.sqrt(observed.observations.squared_errors(state))
    inliers = residuals < threshold  # NaN is none
    found = int(np.count_nonzero(inliers))
    if found < fewest:
        return Failure(
            Reason.TOO_FEW_INLIERS,
            f"{found} inliers of {observed.observations.count} points after {samples} samples, "
            f"{fewest} are needed",
        )
    return Estimate(
        rotation=rotation,
        translation=state[STATE_TRANSLATION] - rotation @ observed.centre,
        angular_velocity=state[STATE_ANGULAR],
        linear_velocity=state[STATE_LINEAR],
        inliers=inliers,
        residuals=residuals,
        joint_covariance=np.full((PARAMETERS, PARAMETERS), np.nan),
        iterations=samples,
        span=observed.sighted.exposure.span,
    )


def estimate_of(
    observed: Observed, posterior: Posterior, samples: int, effect: CalibrationEffect,
    predicted: bool,
) -> Estimate:  # fmt: skip
    """The estimate of an accepted posterior, in the map frame and for all given points.

    Args:
        samples: minimal samples drawn.
        effect: of what map and calibration are off.
        predicted: frames before tell how the camera moves.
    """
    state, turn = posterior.state, observed.sighted.turn
    rotation = rotation_of(state)
    indices, count = observed.sighted.usable.indices, len(observed.sighted.points)
    residuals, inliers = np.full(count, np.nan), np.zeros(count, dtype=np.bool_)
    residuals[indices] = np.sqrt(posterior.squared_errors)
    inliers[indices] = posterior.inliers
    rate, change = state[STATE_ANGULAR], state[STATE_ANGULAR_ACCELERATION]
    covariance = posterior.covariance
    # The noise of this frame is an estimate, and what is on an arc leaves its tangent.
    motion, arched = covariance[:PARAMETERS, :PARAMETERS], posterior.arched
    if arched is None:
        alone = np.zeros((1, PARAMETERS)), motion[None]
        arched = along_arcs(motion, state[STATE_TRANSLATION], np.ones(1), *alone)
    beside = posterior.inflation * arched - motion
    delay = 0.0, math.inf
    if turn is not None:
        rate, change = rate + turn.rate, change + turn.change
        delay = delay_of(observed.observations, posterior, turn)
    return Estimate(
        rotation=rotation,
        translation=state[STATE_TRANSLATION] - rotation @ observed.centre,
        angular_velocity=rate,
        linear_velocity=state[STATE_LINEAR],
        angular_acceleration=change,
        linear_acceleration=state[STATE_LINEAR_ACCELERATION],
        inliers=inliers,
        residuals=residuals,
        joint_covariance=covariance,
        undetected_covariance=posterior.undetected + beside[:MOTION_PARAMETERS, :MOTION_PARAMETERS],
        shake=posterior.shake,
        model_error=posterior.model_error,
        iterations=samples,
        turn=turn,
        delay=delay,
        span=observed.sighted.exposure.span,
        calibration_covariance=effect.covariance,
        still_deviation=effect.still_deviation,
        twist_known=predicted or _knows_velocities(posterior),
    )


def _knows_velocities(posterior: Posterior) -> bool:
    """Whether the points tell the velocities, or certainly rest.

    What they do not tell is a mean about zero, of rest and of all typical speeds: its deviation is
    that of the speeds that are left out of the mean.
    """
    if len(posterior.speeds) and posterior.speeds[0] > _CERTAIN:
        return True
    velocities = posterior.state[POSE_SIZE:]
    return all(
        np.linalg.eigvalsh(posterior.covariance[part, part])[-1]
        < (_TOLD * np.linalg.norm(velocities[part.start - POSE.stop :][:3])) ** 2
        for part in (ANGULAR, LINEAR)
    )
