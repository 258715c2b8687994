"""From a posterior to what users get."""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.state import (
    STATE_ANGULAR,
    STATE_ANGULAR_ACCELERATION,
    STATE_LINEAR,
    STATE_LINEAR_ACCELERATION,
    STATE_TRANSLATION,
    rotation_of,
)
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.delay import delay_of
from rs_localizer.estimation.observing import Observed
from rs_localizer.estimation.posterior import Posterior

_NO_DELAY = (0.0, math.inf)


def estimate_of(observed: Observed, posterior: Posterior, still: int, samples: int) -> Estimate:
    """The estimate of an accepted posterior, in the map frame and for all given points.

    Args:
        still: how many points a global shutter would explain.
        samples: minimal samples drawn.
    """
    state, turn = posterior.state, observed.sighted.turn
    rotation = rotation_of(state)
    residuals = np.full(observed.count, np.nan)
    residuals[observed.usable] = np.sqrt(posterior.squared_errors)
    inliers = np.zeros(observed.count, dtype=np.bool_)
    inliers[observed.usable] = posterior.inliers
    rate, change = state[STATE_ANGULAR], state[STATE_ANGULAR_ACCELERATION]
    delay = _NO_DELAY
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
        joint_covariance=posterior.covariance,
        undetected_covariance=posterior.undetected,
        shake=posterior.shake,
        model_error=posterior.model_error,
        scales=posterior.scales,
        global_shutter_inliers=still,
        iterations=samples,
        turn=turn,
        delay=delay,
    )
