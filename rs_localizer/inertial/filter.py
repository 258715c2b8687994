"""What the frames say of the gyroscope: bias and time offset, tracked beside the camera's motion.

The gyroscope's parameters are a part of the state of the tracker's Kalman filter that no image
shows; they are correlated with what is predicted, because they made the prediction. An image that
moves the motion from ``x`` (covariance ``P``) to ``x'`` (``P'``) therefore moves the parameters,
whose covariance with ``x`` is ``C``, by ``K (x' - x)`` with ``K = C^T P^-1``, takes
``K (P - P') K^T`` from their covariance, and leaves ``P' K^T`` as theirs with ``x'``. This is the
update of the whole filter: given the motion, the image says nothing more of the parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.known_turn import KnownTurn
from rs_localizer.core.shutter import Motion
from rs_localizer.core.state import (
    ANGULAR,
    ANGULAR_ACCELERATION,
    LINEAR,
    LINEAR_ACCELERATION,
    MOVE,
    PARAMETERS,
    TURN,
)
from rs_localizer.inertial import turning
from rs_localizer.inertial.settings import (
    BIAS_DEVIATION,
    OFFSET_DEVIATION,
    OFFSET_WALK,
    InertialSettings,
)
from rs_localizer.inertial.turning import BIAS, OFFSET, GyroscopeErrors, TurnBetween

# An offset that is not estimated is known to this, s.
_GIVEN_OFFSET_DEVIATION = 1e-4
# Of the information that a frame adds at most, so that rounding leaves some variance.
_MOST_GAIN = 0.9999

RATE = np.r_[ANGULAR, ANGULAR_ACCELERATION]
"""Of a step: what the gyroscope leaves to the points."""


@dataclass(frozen=True, slots=True, eq=False)
class Predicted:
    """A motion beside the known turn, before its image."""

    motion: Motion
    covariance: Array  # (18,18)
    with_parameters: Array  # (18,4) covariance with the gyroscope's parameters


class GyroscopeFilter:
    """Bias and time offset of a gyroscope, with the covariance that ties them to the motion."""

    def __init__(self, settings: InertialSettings) -> None:
        self._settings = settings
        self.reset()

    def reset(self, time_offset: float = 0.0, deviation: float | None = None) -> None:
        """Forget what the frames said; begin with a time offset (s) and how well it is known."""
        estimated = self._settings.estimate_time_offset
        if deviation is None:
            deviation = OFFSET_DEVIATION if estimated else _GIVEN_OFFSET_DEVIATION
        deviations = [*3 * [BIAS_DEVIATION], deviation]
        self._set(np.array([0.0, 0.0, 0.0, time_offset]), np.diag(np.square(deviations)))
        self.forget_motion()

    def forget_motion(self) -> None:
        """The next frame does not follow the last one."""
        self._with_motion = np.zeros((PARAMETERS, turning.PARAMETERS))

    def _set(self, parameters: Array, covariance: Array) -> None:
        bias, time_offset = parameters[BIAS], float(parameters[OFFSET])
        noise = self._settings.gyroscope_noise
        self.errors = GyroscopeErrors(bias, time_offset, covariance, noise)

    def walk(self, seconds: float) -> None:
        """Let time pass."""
        covariance = self.errors.covariance.copy()
        covariance[BIAS, BIAS] += self._settings.gyroscope_bias_walk**2 * seconds * np.eye(3)
        if self._settings.estimate_time_offset:
            covariance[OFFSET, OFFSET] += OFFSET_WALK**2 * seconds
        self._set(np.append(self.errors.bias, self.errors.time_offset), covariance)

    def predict(
        self,
        motion: Motion,
        covariance: Array,
        between: TurnBetween,
        within: KnownTurn,
        readouts: float,
        readout_time: float,
        fading: float,
    ) -> Predicted:
        """The motion some readout times later, beside the turn that the gyroscope knows.

        As :func:`rs_localizer.tracking.predict`, but for the rotation: the camera turns as the
        gyroscope says, and what it leaves has no memory but in the parameters.

        Args:
            motion, covariance: of the last frame, beside its known turn; (18,18).
            between, within: turns from the last middle row to this one, and within this frame.
            readouts: from middle row to middle row.
            readout_time: s.
            fading: of accelerations, in readouts.
        """
        left = math.exp(-readouts / fading)
        faster = fading * (1.0 - left)
        farther = fading * (readouts - faster)
        back = between.rotation
        way = readouts * motion.linear_velocity + farther * motion.linear_acceleration
        velocity = back @ (motion.linear_velocity + faster * motion.linear_acceleration)
        later = Motion(
            back @ motion.rotation,
            back @ (motion.translation - way),
            np.zeros(3),
            velocity,
            linear_acceleration=left * back @ motion.linear_acceleration,
        )
        transport = np.zeros((PARAMETERS, PARAMETERS))
        transport[TURN, TURN] = back
        transport[MOVE, MOVE] = back
        transport[MOVE, TURN] = -back @ so3.hat(way)
        transport[MOVE, LINEAR] = readouts * back
        transport[MOVE, LINEAR_ACCELERATION] = farther * back
        transport[LINEAR, LINEAR] = back
        transport[LINEAR, LINEAR_ACCELERATION] = faster * back
        transport[LINEAR_ACCELERATION, LINEAR_ACCELERATION] = left * back
        by_parameters = np.zeros((PARAMETERS, turning.PARAMETERS))
        by_parameters[TURN] = between.by_parameters
        by_parameters[LINEAR] = so3.hat(velocity) @ between.by_parameters
        by_parameters[RATE] = turning.sensitivity(within, readout_time)
        moved = transport @ self._with_motion
        with_parameters = moved + by_parameters @ self.errors.covariance
        crossed = moved @ by_parameters.T
        predicted = transport @ covariance @ transport.T + crossed + crossed.T
        predicted += by_parameters @ self.errors.covariance @ by_parameters.T
        predicted[TURN, TURN] += between.covariance
        predicted[np.ix_(RATE, RATE)] += turning.unforeseen(within, readout_time, self.errors.noise)
        return Predicted(later, predicted, with_parameters)

    def update(self, predicted: Predicted, step: Array, posterior: Array) -> None:
        """Take in a frame that was found near its prediction.

        Args:
            step: (18,) from the prediction to the estimate.
            posterior: (18,18) covariance of the estimate.
        """
        everything = np.arange(PARAMETERS)
        self._update(everything, predicted.covariance, predicted.with_parameters, step, posterior)

    def begin(self, within: KnownTurn, readout_time: float, left: Array, posterior: Array) -> None:
        """Take in a frame of which nothing was known but its turn.

        Args:
            left: (6,) rate and its change that the points left beside the known turn.
            posterior: (18,18) covariance of the estimate.
        """
        with_parameters = turning.sensitivity(within, readout_time) @ self.errors.covariance
        self._update(RATE, within.error, with_parameters, left, posterior)

    def _update(
        self, known: IntArray, before: Array, with_parameters: Array, step: Array, posterior: Array
    ) -> None:
        """``known``: places of a step that the prediction ``before`` was of."""
        after = np.ascontiguousarray(posterior[np.ix_(known, known)])
        gain, gained, left = _gain(before, after, with_parameters)
        covariance = self.errors.covariance - gained
        parameters = np.append(self.errors.bias, self.errors.time_offset) + gain @ step
        tied = left @ gain.T
        if len(known) < PARAMETERS:
            tied = posterior[:, known] @ np.linalg.solve(after, tied)
        self._with_motion = tied
        self._set(parameters, 0.5 * (covariance + covariance.T))


def _gain(before: Array, after: Array, with_parameters: Array) -> tuple[Array, Array, Array]:
    """Gain (4,k), what it takes from the covariance (4,4), and the covariance (k,k) after.

    What shaking and model error make of an estimate's covariance may exceed the prediction's. Such
    a frame says nothing of the parameters, but does not make them worse.
    """
    deviations = np.sqrt(np.diag(before))
    factor = np.linalg.cholesky(before / np.outer(deviations, deviations))
    inverse = np.linalg.inv(factor) / deviations  # of the factor, of what is not scaled
    half = inverse @ with_parameters
    values, vectors = np.linalg.eigh(inverse @ after @ inverse.T)
    values = np.minimum(values, 1.0)
    along = vectors.T @ half
    lost = np.clip(1.0 - values, 0.0, _MOST_GAIN)
    outer = deviations[:, None] * (factor @ vectors)
    left = outer * values @ outer.T
    return half.T @ inverse, along.T * lost @ along, left
