# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The way from a posterior to what users get."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import Reason
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
from rs_localizer.estimation.calibration import CalibrationEffect, promised
from rs_localizer.estimation.gaussian import along_arcs
from rs_localizer.estimation.observations import Observed
from rs_localizer.estimation.posterior import Posterior

# Of a velocity so large a part may be its deviation: it is 0.5 to 1.5 of the true one then.
_TOLD = 0.5
# Probability of rest (in a covariance), beyond which the velocities are none.
_CERTAIN = 0.95


def sample_estimate(
    observed: Observed, state: Array, samples: int, threshold: float, fewest: int
) -> Estimate | Failure:
    """Return the estimate of a minimal sample's model as it is, without a covariance.

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
    """Return the estimate of an accepted posterior, in the map frame, for all given points.

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
    if turn is not None:
        rate, change = rate + turn.rate, change + turn.change
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
        vibrations=posterior.vibrations,
        model_error=posterior.model_error,
        declared_error=promised(posterior),
        iterations=samples,
        turn=turn,
        span=observed.sighted.exposure.span,
        calibration_covariance=effect.covariance,
        still_deviation=effect.still_deviation,
        twist_known=predicted or _knows_velocities(posterior),
    )


def _knows_velocities(posterior: Posterior) -> bool:
    """Return whether the points determine the velocities, or certainly rest.

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
