# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Filter of the gyroscope's bias and time offset, tracked beside the camera's motion.

The gyroscope's parameters are a part of the state of the tracker's Kalman filter that no image
shows; they are correlated with what is predicted, because they made the prediction. An image that
moves the motion from ``x`` (covariance ``P``) to ``x'`` (``P'``) therefore moves the parameters,
whose covariance with ``x`` is ``C``, by ``K (x' - x)`` with ``K = C^T P^-1``, takes
``K (P - P') K^T`` from their covariance, and leaves ``P' K^T`` as theirs with ``x'``. This is the
update of the whole filter: given the motion, the image says nothing more of the parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, IntArray
from rs_localizer.core.shutter import Motion, Numbers, motion_of, numbers_of
from rs_localizer.core.state import (
    ANGULAR,
    ANGULAR_ACCELERATION,
    PARAMETERS,
)
from rs_localizer.inertial import turning
from rs_localizer.inertial.gyroscope_noise import (
    BIAS_DEVIATION,
    JITTER,
    OFFSET_DEVIATION,
    OFFSET_WALK,
    InertialSettings,
)
from rs_localizer.inertial.turning import BIAS, OFFSET, GyroscopeErrors, TurnBetween, TurnWithin
from rs_localizer.native import entry

# An offset that is not estimated is known to this, s.
_GIVEN_OFFSET_DEVIATION = 1e-4
# Biases beyond so many deviations are none.
_MOST_BIAS = 5.0
# Of the information that a frame adds at most, so that rounding leaves some variance.
_MOST_GAIN = 0.9999

RATE = np.r_[ANGULAR, ANGULAR_ACCELERATION]
"""Of a step: what the gyroscope leaves to the points."""
# Deviations between two values of one offset.
_FAR = 4.0
# What the rows say of the time offset is not believed beyond chance (squared, in variances).
_MOST_DELAY = 16.0
# Nor is the offset that the motion says, when it moves by so much (squared) more than the frame's
# information lets it.
_MOST_MOVED, _ROUNDING = 16.0, 1e-12  # s^2
# After a doubt the time offset is known to so many times what is assumed of an IMU nobody knows: a
# clock that is set steps by some 20 ms. Doubts by chance are one in 16,000 frames (four standard
# deviations).
_DOUBT = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Predicted:
    """A motion beside the known turn, before its image."""

    motion: Motion
    covariance: Array  # (18,18)
    with_parameters: Array  # (18,4) covariance with the gyroscope's parameters

    def spread(self, added: Array) -> Predicted:
        """The same with more covariance (18,18) of what the parameters have no part in."""
        return Predicted(self.motion, self.covariance + added, self.with_parameters)


class GyroscopeFilter:
    """Bias and time offset of a gyroscope, with the covariance that ties them to the motion."""

    def __init__(self, settings: InertialSettings) -> None:
        self._settings = settings
        offset_walk = OFFSET_WALK if settings.estimate_time_offset else 0.0
        self._walks = np.square([*3 * [settings.gyroscope_bias_walk], offset_walk])  # per s
        self.reset()

    def reset(self, time_offset: float = 0.0, deviation: float | None = None) -> None:
        """Forget what the frames said; begin with a time offset (s) and how well it is known."""
        estimated = self._settings.estimate_time_offset
        if deviation is None:
            deviation = OFFSET_DEVIATION if estimated else _GIVEN_OFFSET_DEVIATION
        deviations = [*3 * [BIAS_DEVIATION], deviation]
        self._set(np.array([0.0, 0.0, 0.0, time_offset]), np.diag(np.square(deviations)))
        self.forget_motion()

    @property
    def strange(self) -> bool:
        """True for a bias that no gyroscope has."""
        return float(np.abs(self.errors.bias).max()) > _MOST_BIAS * BIAS_DEVIATION

    def contradicts(self, time_offset: float, deviation: float) -> bool:
        """True if another time offset, known to a deviation (s), is not the one of the frames."""
        own = math.sqrt(self.errors.covariance[OFFSET, OFFSET])
        off = abs(time_offset - self.errors.time_offset)
        return off > _FAR * math.hypot(deviation, JITTER) or own > _FAR * deviation

    def forget_motion(self) -> None:
        """The next frame does not follow the last one."""
        self._with_motion = np.zeros((PARAMETERS, turning.PARAMETERS))

    def _set(self, parameters: Array, covariance: Array) -> None:
        bias, time_offset = parameters[BIAS], float(parameters[OFFSET])
        noise = self._settings.gyroscope_noise
        self.errors = GyroscopeErrors(bias, time_offset, np.ascontiguousarray(covariance), noise)

    def walk(self, seconds: float) -> None:
        """Let time pass."""
        covariance = self.errors.covariance + np.diag(seconds * self._walks)
        self.errors = replace(self.errors, covariance=covariance)

    def predict(
        self,
        motion: Motion,
        covariance: Array,
        between: TurnBetween,
        within: TurnWithin,
        readouts: float,
        fading: float,
    ) -> Predicted:
        """The motion some readout times later, beside the turn that the gyroscope knows.

        As :func:`rs_localizer.estimation.motion_model.predict`, but for the rotation: the camera
        turns as the gyroscope says, and what it leaves has no memory but in the parameters.

        Args:
            motion, covariance: of the last frame, beside its known turn; (18,18).
            between, within: turns from the last middle row to this one, and within this frame.
            readouts: from middle row to middle row.
            fading: of accelerations, in readouts.
        """
        if not self._fits(covariance):
            self.forget_motion()
        later, predicted, with_parameters = _carried(
            numbers_of(motion), covariance, self._with_motion, self.errors.covariance,
            between.numbers, within.numbers, float(readouts), float(fading),
        )  # fmt: skip
        return Predicted(motion_of(later), predicted, with_parameters)

    def _fits(self, covariance: Array) -> bool:
        """True if what ties parameters and motion can stand beside this covariance of the motion.

        Where the tracker has put another one in the place of that of the update, as of rest, a
        smaller one would make the prediction indefinite, or a variance of the parameters negative.
        """
        with_motion = self._with_motion
        joint = np.block([[covariance, with_motion], [with_motion.T, self.errors.covariance]])
        scale = np.sqrt(joint.diagonal())
        try:
            np.linalg.cholesky(joint / np.outer(scale, scale))
        except np.linalg.LinAlgError:
            return False
        return True

    def update(self, predicted: Predicted, step: Array, posterior: Array) -> bool:
        """Take in a frame that was found near its prediction.

        Args:
            step: (18,) from the prediction to the estimate.
            posterior: (18,18) covariance of the estimate.

        Returns:
            Whether the time offset that it says can be, by the one that is known.
        """
        before, tied = predicted.covariance, predicted.with_parameters
        return self._update(np.arange(PARAMETERS), before, tied, step, posterior)

    def begin(self, within: TurnWithin, left: Array, posterior: Array) -> None:
        """Take in a frame of which nothing was known but its turn.

        Args:
            left: (6,) rate and its change that the points left beside the known turn.
            posterior: (18,18) covariance of the estimate.
        """
        with_parameters = within.by_parameters @ self.errors.covariance
        self._update(RATE, within.known.error, with_parameters, left, posterior)

    def doubt_offset(self) -> None:
        """Frames contradict the time offset: it is not known as well as it seemed to be."""
        covariance = self.errors.covariance.copy()
        covariance[OFFSET, OFFSET] = (_DOUBT * OFFSET_DEVIATION) ** 2
        self.errors = replace(self.errors, covariance=covariance)

    def hear_delay(self, delay: float, variance: float) -> bool:
        """Take in what the rows of a frame say of the time offset: to be later by ``delay`` (s).

        Their motion stays what it is, so that this is not the best filter, but a consistent one.

        Returns:
            Whether it can be: a delay beyond chance is not believed.
        """
        covariance = self.errors.covariance
        total = float(covariance[OFFSET, OFFSET]) + variance + JITTER**2
        if not self._settings.estimate_time_offset or (math.isinf(variance) and delay == 0.0):
            return True
        if math.isinf(variance) or delay * delay > _MOST_DELAY * total:
            return False
        gain = covariance[:, OFFSET] / total
        parameters = np.append(self.errors.bias, self.errors.time_offset) + gain * delay
        self._with_motion = self._with_motion - np.outer(self._with_motion[:, OFFSET], gain)
        self._set(parameters, covariance - np.outer(gain, covariance[OFFSET]))
        return True

    def _update(
        self, known: IntArray, before: Array, with_parameters: Array, step: Array, posterior: Array
    ) -> bool:
        """``known``: places of a step that the prediction ``before`` was of."""
        whole = len(known) == PARAMETERS
        after = posterior if whole else posterior[np.ix_(known, known)]
        errors = self.errors
        change, covariance, tied = _learned(before, after, with_parameters, errors.covariance, step)
        if not whole:
            tied = posterior[:, known] @ np.linalg.solve(after, tied)
        self._with_motion = np.ascontiguousarray(tied)
        self._set(np.append(errors.bias, errors.time_offset) + change, covariance)
        gained = errors.covariance[OFFSET, OFFSET] - covariance[OFFSET, OFFSET]
        return bool(change[OFFSET] ** 2 <= _MOST_MOVED * max(gained, 0.0) + _ROUNDING)


@entry
def _carried(
    motion: Numbers, covariance: Array2, with_motion: Array2, of_parameters: Array2,
    between: tuple[Array2, Array2, Array1], within: tuple[Array2, Array1], readouts: float,
    fading: float,
) -> tuple[Numbers, Array, Array]:  # fmt: skip
    """A motion, its covariance (18,18), and that with the parameters (18,4), after a turn."""
    rotation, translation, _, linear, _, acceleration = motion
    back, turn_by_parameters, turn_variances = between
    rate_by_parameters, rate_variances = within
    left = math.exp(-readouts / fading)
    # What a unit of acceleration adds to the velocity and to the way.
    faster = fading * (1.0 - left)
    farther = fading * (readouts - faster)
    way = readouts * linear + farther * acceleration
    velocity = back @ (linear + faster * acceleration)
    later = (
        back @ rotation, back @ (translation - way), np.zeros(3), velocity, np.zeros(3),
        left * (back @ acceleration),
    )  # fmt: skip
    transport = np.zeros((PARAMETERS, PARAMETERS))
    by_parameters = np.zeros((PARAMETERS, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for column in range(3):
            b = back[i, column]
            transport[i, column] = b
            transport[3 + i, 3 + column] = b
            transport[3 + i, 9 + column] = readouts * b
            transport[3 + i, 15 + column] = farther * b
            transport[9 + i, 9 + column] = b
            transport[9 + i, 15 + column] = faster * b
            transport[15 + i, 15 + column] = left * b
            # -back hat(way), column by column
            after, before = (column + 1) % 3, (column + 2) % 3
            transport[3 + i, column] = back[i, before] * way[after] - back[i, after] * way[before]
        for column in range(4):
            by_parameters[i, column] = turn_by_parameters[i, column]
            by_parameters[6 + i, column] = rate_by_parameters[i, column]
            by_parameters[12 + i, column] = rate_by_parameters[3 + i, column]
            by_parameters[9 + i, column] = (
                velocity[j] * turn_by_parameters[k, column]
                - velocity[k] * turn_by_parameters[j, column]
            )
    moved = transport @ with_motion
    crossed = moved @ by_parameters.T
    predicted = transport @ covariance @ transport.T + crossed + crossed.T
    predicted += by_parameters @ of_parameters @ by_parameters.T
    for i in range(3):
        predicted[i, i] += turn_variances[i]
        predicted[6 + i, 6 + i] += rate_variances[i]
        predicted[12 + i, 12 + i] += rate_variances[3 + i]
    return later, predicted, moved + by_parameters @ of_parameters


def _learned(
    before: Array, after: Array, with_parameters: Array, of_parameters: Array, step: Array
) -> tuple[Array, Array, Array]:
    """How the parameters (4,) change, their covariance (4,4), and that with the motion (k,4).

    What shaking and model error make of an estimate's covariance may exceed the prediction's. Such
    a frame says nothing of the parameters, but does not make them worse.
    """
    scale = np.sqrt(before.diagonal())
    try:
        root = scale[:, None] * np.linalg.cholesky(before / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return np.zeros(len(of_parameters)), of_parameters, with_parameters
    inverse = np.linalg.inv(root)
    half = inverse @ with_parameters
    values, vectors = np.linalg.eigh(inverse @ after @ inverse.T)
    share = _MOST_GAIN * np.minimum(values, 1.0) + (1.0 - _MOST_GAIN)
    kept = (vectors * share) @ (vectors.T @ half)
    covariance = of_parameters - half.T @ (half - kept)
    return half.T @ inverse @ step, 0.5 * (covariance + covariance.T), root @ kept
