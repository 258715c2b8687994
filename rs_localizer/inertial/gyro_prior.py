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
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import ImuReason, Unused
from rs_localizer.core.rotation_prior import ROTATION, WHOLE, RotationPrior
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
from rs_localizer.estimation.known_rotation import LastFrame, whole_covariance
from rs_localizer.estimation.linear_fit import MIDDLE
from rs_localizer.estimation.prior import Prior, predicted, state_in
from rs_localizer.estimation.robust import inverted
from rs_localizer.estimation.window import MotionSample, numbers_by_name
from rs_localizer.inertial.oddities import LEANING, ComparedTurns, told_by_numbers
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.status import InertialSettings, InertialStatus
from rs_localizer.inertial.turning import (
    BETWEEN,
    BIAS,
    DELAY,
    MOUNT,
    SCALE,
    WITHIN,
    GyroscopeErrors,
    Read,
    read,
    turned,
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
# s: over which rates have changed as they will.
_LATELY = 0.1
_TURNING = np.r_[ANGULAR, ANGULAR_ACCELERATION]
# The middle row's turn by an in-frame turn; its rate is that without the in-frame turn's.
MIDDLE_POSE = np.zeros_like(MIDDLE)
MIDDLE_POSE[TURN] = MIDDLE[TURN]
# Variances of a pose that nothing predicts, rad^2 and m^2.
_ANYWHERE = 1e4
STANDARD_GRAVITY = 9.80665  # m/s^2
_LONGEST, _SHORTEST = 0.4, 0.1  # s of readings of an accelerometer
# rad, of a direction of gravity: biases of consumer accelerometers, and how TF knows their axes.
# Directions that are known worse than the second are none.
_LEAST_LEAN, _MOST_LEAN = 0.03, 0.5
_NO_READINGS = Unused(ImuReason.LATE, "no readings of the exposure have come")


class GyroPrediction(NamedTuple):
    """The gyroscope's knowledge of a frame: of the motion beside the rotation within it, too."""

    rotation: RotationPrior
    prior: Prior | None  # of the motion beside the rotation; None: nothing follows from before
    motion: Motion | None  # likewise
    covariance: Array  # (72,72) of that motion and the in-frame turn
    tied: Array  # (72,10) covariance with what the gyroscope is off by

    def of(self, last: Estimate) -> Estimate:
        """Return the estimate that it makes of the last frame's."""
        assert self.motion is not None
        known = self.rotation
        numbers = numbers_by_name(self.motion)
        numbers |= {"angular_velocity": known.rate, "angular_acceleration": known.change}
        covariance = whole_covariance(self.covariance)
        return last.with_joint_covariance(covariance, **numbers, shake=known.shake)


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
        deviations = np.zeros(ERRORS)
        deviations[BIAS], deviations[DELAY] = _BIAS_DEVIATION, settings.time_offset_deviation
        deviations[SCALE], deviations[MOUNT] = settings.scale_deviation, settings.mount_deviation
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
        up = self._settings.gravity_in_map
        if found is None or up is None:
            return found
        seen = gravity_seen(samples, middle_ns, self.errors)
        if seen is None:
            return found
        prior = Prior(gravity=seen[0], gravity_deviation=seen[1], gravity_in_map=up)
        return found._replace(prior=prior)

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
            rotation, tied = rotation_by(found, self.errors), np.zeros((WHOLE, ERRORS))
            tied[ROTATION] = found.by_errors[WITHIN] @ self.errors.covariance
            covariance = rotation.covariance.copy()
            others = np.setdiff1d(np.arange(PARAMETERS), ROTATION)
            covariance[others, others] = _ANYWHERE
            return GyroPrediction(rotation, None, None, covariance, tied)
        motion, covariance, tied = self._carried(found, last, 1e-9 * (middle_ns - last.middle_ns))
        rotation = RotationPrior(*found[:3], covariance, predicted=True)
        prior = predicted(motion, covariance[:PARAMETERS, :PARAMETERS])
        if prior is None:
            return None
        return GyroPrediction(rotation, prior, motion, covariance, tied)

    def _carried(self, found: Read, last: LastFrame, seconds: float) -> tuple[Motion, Array, Array]:
        """Return the motion after a turn, beside the rotation within this frame.

        With its covariance (72,72), and that with the errors (72,10), as of a prediction.
        """
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
        joint = np.hstack([np.vstack([last.covariance, tied.T]), np.vstack([tied, known])])
        if np.isnan(inverted(joint)[0, 0]):
            tied = np.zeros_like(tied)
        tied = np.concatenate([transport @ tied, np.zeros((WHOLE - PARAMETERS, ERRORS))])
        crossed = tied @ by_errors.T
        covariance = crossed + crossed.T + by_errors @ known @ by_errors.T
        covariance += by_told @ found.rest @ by_told.T
        covariance[motions, motions] += transport @ last.covariance @ transport.T + last.added
        return motion, 0.5 * (covariance + covariance.T), tied + by_errors @ known

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
        motions, start, information = slice(0, PARAMETERS), told.state.copy(), told.information
        if prediction.motion is not None:
            start = state_in(prediction.motion, np.zeros(3))
        else:  # it knows the rotation alone
            start[STATE_ANGULAR] = start[STATE_ANGULAR_ACCELERATION] = 0.0
        spread = prediction.covariance[motions, motions].copy()
        pull = told.gradient + information @ step_between(start, told.state)
        gain = np.asarray(np.linalg.inv(np.eye(PARAMETERS) + spread @ information), np.float64)
        step, gained = gain @ spread @ pull, spread @ information @ gain @ spread
        seen = np.ix_(_SEEN, _SEEN)
        expected = gained[seen] + _LEAST_GAIN * spread[seen]
        far = float(step[_SEEN] @ np.linalg.solve(expected, step[_SEEN])) / _MOST_DISTANCE
        if far > 1.0:  # a prediction that is too far off counts as much as one at the limit
            information, pull = information / far, pull / far
            gain[:] = np.linalg.inv(np.eye(PARAMETERS) + spread @ information)
        self._learn(prediction.tied[motions], gain, information, pull)
        agrees = bool(far <= 1.0)
        self._contradictions.append(not agrees)
        self._age += 1
        if not agrees:
            self.forget_motion()
            if sum(self._contradictions) >= _CONTRADICTIONS and self._age >= _WATCHED:
                self._former = self.errors
                self._begin()
        # What was contradicted often agrees by chance where the camera hardly turns.
        contradicted, self._unused = self.contradicted, None
        if contradicted or not agrees:
            said = self._oddity() or "the camera and the gyroscope turn differently"
            reason = ImuReason.DISAGREES if contradicted else ImuReason.DOUBTED
            self._unused = Unused(reason, said)
        return self._unused is None

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

    def _oddity(self) -> str:
        """Return in words what it has that the settings hardly allow for; empty: nothing."""
        if self._is_another():
            return self._turns.told()
        if any(self._contradictions):  # by frames that the numbers did not foresee
            return ""
        return told_by_numbers(self.errors, self._before_all.diagonal(), self._former)


def rotation_by(found: Read, errors: GyroscopeErrors) -> RotationPrior:
    """Return what readings tell of the rotation within a frame, if nothing predicts its motion."""
    within, covariance = found.by_errors[WITHIN], np.zeros((WHOLE, WHOLE))
    known = within @ errors.covariance @ within.T + found.rest[WITHIN, WITHIN]
    covariance[np.ix_(ROTATION, ROTATION)] = known
    return RotationPrior(*found[:3], covariance, predicted=False)


def gravity_seen(
    samples: ImuSamples, middle_ns: int, errors: GyroscopeErrors
) -> tuple[Array, float] | None:
    """Return a vector (3,) along gravity in camera axes, and its deviation in rad; or None.

    An accelerometer measures gravity, upwards, and the acceleration of the camera. One reading does
    not tell them apart, but no camera accelerates one way for long. So the gyroscope rotates the
    readings of the last moments into the present axes, and their mean is the direction. Their
    differences, from each other and from g in length, give its uncertainty. None without an
    accelerometer, where the readings are too few, or where the camera accelerates too much.
    """
    if samples.specific_force is None:
        return None
    now_ns = middle_ns - round(1e9 * errors.time_offset)  # by the clock of the samples
    chosen = np.abs(samples.times_ns - now_ns) <= round(1e9 * _LONGEST)
    times = np.asarray(1e-9 * (samples.times_ns[chosen] - now_ns), np.float64)
    if len(times) < 2 or not (times[0] < -_SHORTEST and times[-1] >= 0.0):
        return None
    rates = samples.angular_velocity[chosen] - errors.bias
    turns = turned(times, np.concatenate([rates, 0.5 * (rates[1:] + rates[:-1])]))
    # In the axes of the reading that is nearest to now.
    forces = np.einsum("nji,nj->ni", turns, samples.specific_force[chosen])
    forces = forces @ turns[np.abs(times).argmin()].T
    force = forces.mean(axis=0)
    length = float(np.linalg.norm(force))
    scatter = math.sqrt(float(np.mean(np.var(forces, axis=0))))
    strange = math.hypot(length - STANDARD_GRAVITY, scatter) / STANDARD_GRAVITY
    deviation = math.hypot(_LEAST_LEAN, strange)
    return None if deviation > _MOST_LEAN else (-force / length, deviation)
