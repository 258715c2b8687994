# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A gyroscope as a prior of a frame's motion, and what frames tell of the gyroscope.

The track knows the errors of the gyroscope (:mod:`.turning`) as a Gaussian, which begins with the
deviations of the settings. These errors are correlated with the prediction that they made. Let
``x`` be the predicted motion, ``P`` its covariance, and ``C`` the covariance of the errors with it.
Points that tell ``r`` and an information ``L`` of the motion move both:

    x by G P r,   the numbers by C^T G^T r,   G = (I + P L)^-1

This is the update of a Kalman filter of all of them. The points tell the camera's own rotation. If
it is farther from the prediction than once in a thousand by chance, the gyroscope is contradicted,
and the frame is fitted without it.
"""

from __future__ import annotations

import math
from collections import deque
from copy import copy
from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import ImuReason, Unused
from rs_localizer.core.rotation_prior import ROTATION, WHOLE, RotationPrior
from rs_localizer.core.shake import COMBINATIONS, shake_functions
from rs_localizer.core.shutter import Motion, carried, motion_of, numbers_of
from rs_localizer.core.state import (
    ANGULAR,
    ANGULAR_ACCELERATION,
    LINEAR,
    PARAMETERS,
    STATE_ANGULAR,
    STATE_ANGULAR_ACCELERATION,
    TURN,
    step_between,
)
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.known_rotation import LastFrame, turn_of, whole_covariance
from rs_localizer.estimation.linear_fit import BLOCKS, MIDDLE, TURNS
from rs_localizer.estimation.prior import Prior, predicted, state_in
from rs_localizer.estimation.window import MotionSample
from rs_localizer.inertial.gravity import gravity_seen
from rs_localizer.inertial.oddities import LEANING, ComparedTurns, told_by_numbers
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.status import InertialSettings, InertialStatus
from rs_localizer.inertial.turning import (
    BETWEEN,
    BIAS,
    DELAY,
    MOUNT,
    WITHIN,
    GyroscopeErrors,
    Read,
    read,
)
from rs_localizer.inertial.turning import PARAMETERS as ERRORS

# Deviation (s) of a gyroscope's delay that no frames estimate: it is the given one.
_GIVEN_DELAY = 1e-4
# Biases of gyroscopes that were never calibrated, rad/s, of each axis.
_BIAS_DEVIATION = math.radians(3.0)
# Clocks drift apart, s/sqrt(s).
_DELAY_WALK = 5e-6
# Parts of a step that a gyroscope contradicts, and the 99.9 % quantile of chi-squared of six
# numbers.
_SEEN = np.r_[TURN, ANGULAR]
_MOST_DISTANCE = 22.46
# Least share of a prediction's covariance by which points know a motion better, so that it is no
# rounding.
_LEAST_GAIN = 0.03
# If so many of the last frames contradict a gyroscope, that is no chance, and it has changed: what
# it is off by is learned anew.
_WATCHED, _CONTRADICTIONS = 12, 4
# A delay is hardly known whose deviation is this part of what it was at first.
_HARDLY = 0.25
# Row times at which a turn beside the gyroscope's is compared with none, and the 99.9 % quantile of
# chi-squared of its twelve numbers: a half cycle per readout and more.
_ROWS, _MOST_SWING = (-0.375, -0.125, 0.125, 0.375), 32.91
# Size of vibration, over an ordinary one, that does not matter.
_LEAST_SWING = 0.3
# s: over which rates have changed as they will.
_LATELY = 0.1
_TURNING = np.r_[ANGULAR, ANGULAR_ACCELERATION]
# The middle row's turn by an in-frame turn; its rate is that without the in-frame turn's.
MIDDLE_POSE = np.zeros_like(MIDDLE)
MIDDLE_POSE[TURN] = MIDDLE[TURN]
# Variances of a pose that nothing predicts, rad^2 and m^2.
_ANYWHERE = 1e4
_NO_READINGS = Unused(ImuReason.LATE, "no readings of the exposure have come")


class _Foreseen(NamedTuple):
    """A motion beside the known rotation before its points, with the gyroscope's numbers."""

    motion: Motion
    covariance: Array  # (72,72), or of the motion alone (18,18)
    tied: Array  # (72,10), or (18,10), covariance with the numbers


class GyroPrediction(NamedTuple):
    """The gyroscope's knowledge of a frame."""

    readings: Read
    rotation: RotationPrior
    prior: Prior | None  # of the motion beside the rotation; None: nothing follows from before
    foreseen: _Foreseen | None

    def of(self, last: Estimate) -> Estimate:
        """Return the estimate that it makes of the last frame's."""
        assert self.foreseen is not None
        motion, known = self.foreseen.motion, self.rotation
        numbers = {each.name: getattr(motion, each.name) for each in fields(Motion)}
        numbers["angular_velocity"], numbers["angular_acceleration"] = known.rate, known.change
        return last.with_joint_covariance(
            whole_covariance(self.foreseen.covariance), **numbers, shake=known.shake
        )


class GyroscopeTrack:
    """The track of what the gyroscope of one camera is off by.

    Args:
        settings: what is known of it.
        readout_time: s, of the camera.
    """

    def __init__(self, settings: InertialSettings, readout_time: float) -> None:
        self._settings, self._readout_time = settings, readout_time
        self._prepare()

    def forget_delay(self) -> None:
        """Take the given delay for the right one: no frames will tell."""
        self._settings = replace(self._settings, time_offset_deviation=_GIVEN_DELAY)
        self._prepare()

    def _prepare(self) -> None:
        settings = self._settings
        deviations = np.repeat(
            [
                _BIAS_DEVIATION, settings.time_offset_deviation, settings.scale_deviation,
                settings.mount_deviation,
            ],
            [3, 1, 3, 3],
        )  # fmt: skip
        self._before_all = np.diag(deviations**2)
        self._walk = np.zeros(ERRORS)  # per s
        self._walk[BIAS], self._walk[DELAY] = settings.gyroscope_bias_walk**2, _DELAY_WALK**2
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._begin()
        self._former: GyroscopeErrors | None = None
        self._last_ns: int | None = None
        self._unused: Unused | None = _NO_READINGS
        self._contradictions: deque[bool] = deque(maxlen=_WATCHED)
        self._age = 0  # frames since the numbers began
        self._turns = ComparedTurns()

    def _begin(self) -> None:
        self.errors = GyroscopeErrors(
            np.zeros(ERRORS), self._before_all.copy(), self._settings.gyroscope_noise
        )
        self._tied, self._age = np.zeros((PARAMETERS, ERRORS)), 0

    def snapshot(self) -> GyroscopeTrack:
        """Return a copy for :meth:`ahead`, which frames that come later do not change."""
        return copy(self)

    @property
    def status(self) -> InertialStatus:
        """The gyroscope after the last frame."""
        errors = self.errors
        variances = errors.covariance.diagonal()
        return InertialStatus(
            self._unused, errors.bias, math.sqrt(variances[BIAS].mean()), errors.time_offset,
            math.sqrt(variances[DELAY].item()), self._oddity(),
        )  # fmt: skip

    @property
    def agreed(self) -> bool:
        """Whether the last frame agreed with the gyroscope."""
        return self._unused is None

    def last_ns(self, samples: ImuSamples) -> int:
        """Return the last moment that samples cover, by the camera's clock."""
        return int(samples.times_ns[-1]) + round(1e9 * self.errors.time_offset) - 1

    def foresee(
        self, samples: ImuSamples | None, middle_ns: int, last: LastFrame | None
    ) -> GyroPrediction | None:
        """Return what it says of a frame before its points; None: samples do not cover the frame.

        Args:
            middle_ns: exposure of the middle row.
            last: the last frame; None: there is no track.
        """
        if self._last_ns is not None and middle_ns > self._last_ns:
            walked = 1e-9 * (middle_ns - self._last_ns) * self._walk
            covariance = self.errors.covariance + np.diag(walked)
            self.errors = replace(self.errors, covariance=covariance)
        self._last_ns, self._unused = middle_ns, _NO_READINGS
        if samples is None or len(samples) == 0:
            self.forget_motion()
            return None
        if last is not None:
            self._turns.add(samples, last)
        found = None if last is None else self.ahead(samples, middle_ns, last)
        if found is not None:
            return found
        self.forget_motion()
        found = self.ahead(samples, middle_ns, None) or self._strayed(samples, middle_ns)
        if found is None:
            return None
        return found._replace(prior=self._gravity(samples, middle_ns))

    def _strayed(self, samples: ImuSamples, middle_ns: int) -> GyroPrediction | None:
        """Begin anew, if a delay that is hardly known leads away from the samples."""
        known, before = self.errors.covariance[DELAY, DELAY], self._before_all[DELAY, DELAY]
        if known.item() < _HARDLY**2 * before.item():
            return None
        self._begin()
        return self.ahead(samples, middle_ns, None)

    def forget_motion(self) -> None:
        """Forget how the last motion goes with what the gyroscope is off by."""
        self._tied = np.zeros((PARAMETERS, ERRORS))

    def ahead(
        self, samples: ImuSamples, middle_ns: int, last: LastFrame | None
    ) -> GyroPrediction | None:
        """Return the prediction of a moment after the last frame, as if it were a frame's.

        It is None if samples do not cover it.
        """
        since = None if last is None else last.middle_ns
        found = read(samples, middle_ns, self._readout_time, self.errors, since)
        if found is None:
            return None
        if last is None:
            return GyroPrediction(found, rotation_by(found, self.errors), None, None)
        foreseen = self._carried(found, last, 1e-9 * (middle_ns - last.middle_ns))
        rotation = RotationPrior(*found[:3], foreseen.covariance, predicted=True)
        prior = predicted(foreseen.motion, foreseen.covariance[:PARAMETERS, :PARAMETERS])
        return None if prior is None else GyroPrediction(found, rotation, prior, foreseen)

    def _gravity(self, samples: ImuSamples, middle_ns: int) -> Prior | None:
        up = self._settings.gravity_in_map
        seen = None if up is None else gravity_seen(samples, middle_ns, self.errors)
        if up is None or seen is None:
            return None
        return Prior(gravity=seen[0], gravity_deviation=seen[1], gravity_in_map=up)

    def _carried(self, found: Read, last: LastFrame, seconds: float) -> _Foreseen:
        """Return the motion after a turn, beside the rotation within this frame."""
        assert found.between is not None
        still = replace(last.motion, angular_velocity=np.zeros(3), angular_acceleration=np.zeros(3))
        later, transport = carried(numbers_of(still), seconds / self._readout_time, last.fading)
        transport[:, _TURNING] = 0.0  # the camera turns as the gyroscope says
        for k in range(0, PARAMETERS, 3):
            transport[k : k + 3] = found.between @ transport[k : k + 3]
        names = ("rotation", "translation", "linear_velocity", "linear_acceleration")
        moved = motion_of(later)
        motion = replace(moved, **{
            name: np.ascontiguousarray(found.between @ getattr(moved, name)) for name in names
        })  # fmt: skip
        # Of all numbers by those that the gyroscope tells.
        by_told = np.zeros((WHOLE, len(found.by_errors)))
        by_told[TURN, BETWEEN], by_told[ROTATION, WITHIN] = np.eye(3), np.eye(len(ROTATION))
        by_told[LINEAR, BETWEEN] = so3.hat(motion.linear_velocity)
        by_told[:PARAMETERS] -= MIDDLE_POSE @ by_told[PARAMETERS:]
        by_errors = by_told @ found.by_errors
        known, tied, motions = self.errors.covariance, self._tied, slice(0, PARAMETERS)
        if not _is_positive(np.block([[last.covariance, tied], [tied.T, known]])):
            tied = np.zeros_like(tied)
        tied = np.concatenate([transport @ tied, np.zeros((WHOLE - PARAMETERS, ERRORS))])
        crossed = tied @ by_errors.T
        covariance = crossed + crossed.T + by_errors @ known @ by_errors.T
        covariance += by_told @ found.rest @ by_told.T
        covariance[motions, motions] += transport @ last.covariance @ transport.T + last.added
        return _Foreseen(motion, 0.5 * (covariance + covariance.T), tied + by_errors @ known)

    def changed(self, samples: ImuSamples, seconds: float) -> float:
        """Return the mean squared change of an axis' rates (rad/s)^2 in so many s, of late."""
        times = 1e-9 * (samples.times_ns - samples.times_ns[-1])
        late = times >= times[0] + seconds
        late &= times >= -_LATELY
        if not late.any():
            return math.inf
        rates = samples.angular_velocity
        before = [np.interp(times[late] - seconds, times, rates[:, axis]) for axis in range(3)]
        return float(np.mean((rates[late] - np.transpose(before)) ** 2))

    def agrees(self, prediction: GyroPrediction, found: Estimate, told: MotionSample) -> bool:
        """Learn from a frame, and return whether the camera's own rotation is the gyroscope's.

        Args:
            found: the frame, with the gyroscope or without.
            told: what its points tell of its motion.
        """
        told = told.over(found.span)
        told.state[STATE_ANGULAR] -= prediction.rotation.smooth_rate
        told.state[STATE_ANGULAR_ACCELERATION] -= prediction.rotation.change
        foreseen = prediction.foreseen or self._of_rotation(prediction, told)
        motions = slice(0, PARAMETERS)
        spread, information = foreseen.covariance[motions, motions].copy(), told.information
        start = state_in(foreseen.motion, np.zeros(3))
        pull = told.gradient + information @ step_between(start, told.state)
        gain = np.asarray(np.linalg.inv(np.eye(PARAMETERS) + spread @ information), np.float64)
        step, gained = gain @ spread @ pull, spread @ information @ gain @ spread
        seen = np.ix_(_SEEN, _SEEN)
        expected = gained[seen] + _LEAST_GAIN * spread[seen]
        far = float(step[_SEEN] @ np.linalg.solve(expected, step[_SEEN])) / _MOST_DISTANCE
        if found.aided:
            far = max(far, _swung(found, prediction.rotation) / _MOST_SWING)
        if far > 1.0:  # a prediction that is too far off counts as much as one at the limit
            information, pull = information / far, pull / far
            gain[:] = np.linalg.inv(np.eye(PARAMETERS) + spread @ information)
        self._learn(foreseen.tied[motions], gain, information, pull)
        agrees = bool(far <= 1.0)
        self._contradictions.append(not agrees)
        self._age += 1
        if not agrees:
            self.forget_motion()
            if sum(self._contradictions) >= _CONTRADICTIONS and self._age >= _WATCHED:
                self._former = self.errors
                self._begin()
        # What was contradicted often agrees by chance where the camera hardly turns.
        reason = ImuReason.DISAGREES if self.contradicted else ImuReason.DOUBTED
        is_used = agrees and not self.contradicted
        said = self._oddity() or "the camera and the gyroscope turn differently"
        self._unused = None if is_used else Unused(reason, said)
        return is_used

    @property
    def contradicted(self) -> bool:
        """Whether images contradict it, or what it is off by is hard to learn."""
        # What leans far is off by more than a linear error.
        leans = float(np.linalg.norm(self.errors.mean[MOUNT])) > LEANING
        return leans or self._is_another()

    def _is_another(self) -> bool:
        """Return whether images contradict it, or have, and their turns tell why."""
        often = sum(self._contradictions) >= _CONTRADICTIONS
        return often or (self._former is not None and self._turns.told() != "")

    def _learn(self, tied: Array, gain: Array, information: Array, pull: Array) -> None:
        mean = self.errors.mean + tied.T @ gain.T @ pull
        covariance = self.errors.covariance - tied.T @ information @ gain @ tied
        covariance = 0.5 * (covariance + covariance.T)
        self.errors = replace(self.errors, mean=mean, covariance=covariance)
        self._tied = gain @ tied

    def _of_rotation(self, prediction: GyroPrediction, told: MotionSample) -> _Foreseen:
        """Return what it says of a frame that follows no other, near what its points tell."""
        state = told.state
        motion = Motion(
            state[:9].reshape(3, 3), state[9:12], np.zeros(3), state[15:18],
            linear_acceleration=state[21:24],
        )  # fmt: skip
        covariance = prediction.rotation.covariance.copy()
        others = np.setdiff1d(np.arange(PARAMETERS), ROTATION)
        covariance[others, others] = _ANYWHERE
        tied = np.zeros((WHOLE, ERRORS))
        tied[ROTATION] = prediction.readings.by_errors[WITHIN] @ self.errors.covariance
        return _Foreseen(motion, covariance, tied)

    def _oddity(self) -> str:
        """Return in words what it has that the settings hardly allow for; empty: nothing."""
        if self._is_another():
            return self._turns.told()
        return told_by_numbers(self.errors, self._before_all.diagonal(), self._former)


def rotation_by(found: Read, errors: GyroscopeErrors) -> RotationPrior:
    """Return what readings tell of the rotation within a frame, if nothing predicts its motion."""
    within, covariance = found.by_errors[WITHIN], np.zeros((WHOLE, WHOLE))
    known = within @ errors.covariance @ within.T + found.rest[WITHIN, WITHIN]
    covariance[np.ix_(ROTATION, ROTATION)] = known
    return RotationPrior(*found[:3], covariance, predicted=False)


def _swung(found: Estimate, rotation: RotationPrior) -> float:
    """Return the squared size, in deviations, of a vibration that points see beside it."""
    turn = turn_of(rotation.beside(found))
    place = BLOCKS["turn"]
    known = rotation.covariance[place, place] + _LEAST_SWING**2 * np.eye(TURNS)
    covariance = _SWINGS @ known @ _SWINGS.T
    seen = _SWINGS @ turn
    return float(seen @ np.linalg.solve(covariance, seen))


# Derivatives (12,54) of turns at the row times by an in-frame turn.
_SWINGS = np.asarray(
    np.kron(shake_functions(np.array(_ROWS))[0] @ COMBINATIONS, np.eye(3)), np.float64
)


def _is_positive(joint: Array) -> bool:
    scale = np.sqrt(joint.diagonal())
    try:
        np.linalg.cholesky(joint / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return False
    return True
