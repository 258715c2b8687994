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
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.gyro_rotation import GyroRotation, late_at
from rs_localizer.core.reasons import ImuReason
from rs_localizer.core.shake import FUNCTIONS, shake_basis
from rs_localizer.core.shutter import Motion, carried, motion_of, numbers_of
from rs_localizer.core.state import (
    ANGULAR,
    ANGULAR_ACCELERATION,
    LINEAR,
    PARAMETERS,
    TURN,
    step_between,
)
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.prior import Prior, state_in
from rs_localizer.estimation.window import MotionSample
from rs_localizer.inertial.gravity import gravity_seen
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.status import InertialSettings, InertialStatus, Unused
from rs_localizer.inertial.turning import (
    BETWEEN,
    BIAS,
    CHANGE,
    DELAY,
    MOUNT,
    RATE,
    SCALE,
    GyroscopeErrors,
    Rotated,
    rotated,
)
from rs_localizer.inertial.turning import PARAMETERS as ERRORS

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
_LEAST_GAIN = 1e-6
# If so many of the last frames contradict a gyroscope, that is no chance, and it has changed: what
# it is off by is learned anew.
_WATCHED, _CONTRADICTIONS = 12, 4
# 99.9 % quantiles of chi-squared of 1 and 3 numbers: what is known to be off by more than the
# settings allow is named.
_CERTAIN = {1: 10.83, 3: 16.27}
# A delay is hardly known whose deviation is this part of what it was at first.
_HARDLY = 0.25
# Row times at which a turn beside the gyroscope's is compared with none, and the 99.9 % quantile of
# chi-squared of its twelve numbers: a half cycle per readout and more.
_ROWS, _MOST_SWING = (-0.375, -0.125, 0.125, 0.375), 32.91
# The squares of a wave are at most twice their mean.
_PEAK = 2.0
# s: over which rates have changed as they will.
_LATELY = 0.1
_TURNING = np.r_[ANGULAR, ANGULAR_ACCELERATION]
# Variances of a pose that nothing predicts, rad^2 and m^2.
_ANYWHERE = 1e4


@dataclass(frozen=True, slots=True, eq=False)
class Before:
    """The last frame with a pose, for a prediction."""

    middle_ns: int
    motion: Motion  # beside its known turn
    covariance: Array  # (18,18)
    added: Array  # (18,18) that the prediction gets, but for the rotation
    fading: float  # of accelerations, in readouts


class _Foreseen(NamedTuple):
    """A motion beside the known turn before its points, with the gyroscope's numbers."""

    motion: Motion
    covariance: Array  # (18,18)
    tied: Array  # (18,10) covariance with the numbers


@dataclass(frozen=True, slots=True, eq=False)
class GyroPrediction:
    """The gyroscope's knowledge of a frame."""

    rotation: Rotated
    prior: Prior | None  # of the motion beside the turn; None: nothing follows from before
    foreseen: _Foreseen | None

    @property
    def turn(self) -> GyroRotation:
        return self.rotation.known

    def of(self, last: Estimate) -> Estimate:
        """Return the estimate that it makes of the last frame's."""
        assert self.foreseen is not None
        motion, turn = self.foreseen.motion, self.turn
        numbers = {each.name: getattr(motion, each.name) for each in fields(Motion)}
        numbers["angular_velocity"] = motion.angular_velocity + turn.rate
        numbers["angular_acceleration"] = motion.angular_acceleration + turn.change
        return last.with_joint_covariance(
            self.foreseen.covariance, **numbers, shake=np.zeros((0, 3)), turn=turn
        )


class GyroscopeTrack:
    """The track of what the gyroscope of one camera is off by.

    Args:
        settings: what is known of it.
        readout_time: s, of the camera.
    """

    def __init__(self, settings: InertialSettings, readout_time: float) -> None:
        self._settings, self._readout_time = settings, readout_time
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
        self._unused: Unused | None = Unused(ImuReason.LATE)
        self._contradictions: deque[bool] = deque(maxlen=_WATCHED)
        self._age = 0  # frames since the numbers began

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
        self, samples: ImuSamples | None, middle_ns: int, last: Before | None
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
        self._last_ns, self._unused = middle_ns, Unused(ImuReason.LATE)
        if samples is None or len(samples) == 0:
            self.forget_motion()
            return None
        found = None if last is None else self.ahead(samples, middle_ns, last)
        if found is not None:
            return found
        self.forget_motion()
        found = self.ahead(samples, middle_ns, None) or self._strayed(samples, middle_ns)
        if found is None:
            return None
        return replace(found, prior=self._gravity(samples, middle_ns))

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
        self, samples: ImuSamples, middle_ns: int, last: Before | None
    ) -> GyroPrediction | None:
        """Return the prediction of a moment after the last frame, as if it were a frame's.

        It is None if samples do not cover it.
        """
        since = None if last is None else last.middle_ns
        turned = rotated(samples, middle_ns, self._readout_time, self.errors, since)
        if turned is None:
            return None
        if last is None:
            return GyroPrediction(turned, None, None)
        foreseen = self._carried(turned, last, 1e-9 * (middle_ns - last.middle_ns))
        prior = Prior(motion=foreseen.motion, covariance=foreseen.covariance)
        return GyroPrediction(turned, prior, foreseen)

    def _gravity(self, samples: ImuSamples, middle_ns: int) -> Prior | None:
        up = self._settings.gravity_in_map
        seen = None if up is None else gravity_seen(samples, middle_ns, self.errors)
        if up is None or seen is None:
            return None
        return Prior(gravity=seen[0], gravity_deviation=seen[1], gravity_in_map=up)

    def _carried(self, turned: Rotated, last: Before, seconds: float) -> _Foreseen:
        """Return the motion after a turn, beside the rotation within this frame."""
        assert turned.between is not None
        still = replace(last.motion, angular_velocity=np.zeros(3), angular_acceleration=np.zeros(3))
        later, transport = carried(numbers_of(still), seconds / self._readout_time, last.fading)
        transport[:, _TURNING] = 0.0  # the camera turns as the gyroscope says
        for k in range(0, PARAMETERS, 3):
            transport[k : k + 3] = turned.between @ transport[k : k + 3]
        names = ("rotation", "translation", "linear_velocity", "linear_acceleration")
        moved = motion_of(later)
        motion = replace(moved, **{
            name: np.ascontiguousarray(turned.between @ getattr(moved, name)) for name in names
        })  # fmt: skip
        by_errors = np.zeros((PARAMETERS, ERRORS))
        by_errors[TURN] = turned.by_errors[BETWEEN]
        by_errors[ANGULAR], by_errors[ANGULAR_ACCELERATION] = (
            turned.by_errors[RATE], turned.by_errors[CHANGE],
        )  # fmt: skip
        by_errors[LINEAR] = np.cross(motion.linear_velocity, turned.by_errors[BETWEEN].T).T
        known, tied = self.errors.covariance, self._tied
        if not _is_positive(np.block([[last.covariance, tied], [tied.T, known]])):
            tied = np.zeros_like(tied)
        crossed = transport @ tied @ by_errors.T
        covariance = transport @ last.covariance @ transport.T + crossed + crossed.T
        covariance += by_errors @ known @ by_errors.T + last.added
        places = np.r_[TURN, _TURNING]
        covariance[places, places] += turned.variances
        return _Foreseen(
            motion, 0.5 * (covariance + covariance.T), transport @ tied + by_errors @ known
        )

    def agrees(self, prediction: GyroPrediction, found: Estimate, told: MotionSample) -> bool:
        """Learn from a frame, and return whether the camera's own rotation is the gyroscope's.

        Args:
            found: the frame, with the gyroscope or without.
            told: what points tell of the motion beside the known turn, per readout.
        """
        foreseen = prediction.foreseen or self._of_turn(prediction.rotation, told)
        spread, information = foreseen.covariance, told.information
        start = state_in(foreseen.motion, np.zeros(3))
        pull = told.gradient + information @ step_between(start, told.state)
        gain = np.linalg.inv(np.eye(PARAMETERS) + spread @ information)
        step, gained = gain @ spread @ pull, spread @ information @ gain @ spread
        seen = np.ix_(_SEEN, _SEEN)
        expected = gained[seen] + _LEAST_GAIN * spread[seen]
        far = float(step[_SEEN] @ np.linalg.solve(expected, step[_SEEN])) / _MOST_DISTANCE
        far = max(far, _swung(found, prediction.rotation) / _MOST_SWING)
        # A prediction that is too far off counts as much as one at the limit.
        self._learn(foreseen, information / max(far, 1.0), pull / max(far, 1.0))
        agrees = bool(far <= 1.0)
        self._contradictions.append(not agrees)
        self._age += 1
        often = sum(self._contradictions) >= _CONTRADICTIONS
        if not agrees:
            self.forget_motion()
            if often and self._age >= _WATCHED:
                self._former = self.errors
                self._begin()
        # What was contradicted often agrees by chance where the camera hardly turns.
        reason = ImuReason.DISAGREES if often else ImuReason.DOUBTED
        self._unused = None if agrees and not often else Unused(reason, self._oddity())
        return self._unused is None

    def _learn(self, foreseen: _Foreseen, information: Array, pull: Array) -> None:
        spread, tied = foreseen.covariance, foreseen.tied
        gain = np.linalg.inv(np.eye(PARAMETERS) + spread @ information)
        mean = self.errors.mean + tied.T @ gain.T @ pull
        covariance = self.errors.covariance - tied.T @ information @ gain @ tied
        covariance = 0.5 * (covariance + covariance.T)
        self.errors = replace(self.errors, mean=mean, covariance=covariance)
        self._tied = gain @ tied

    def _of_turn(self, turned: Rotated, told: MotionSample) -> _Foreseen:
        """Return what it says of a frame that follows no other, near what its points tell."""
        state = told.state
        motion = Motion(
            state[:9].reshape(3, 3), state[9:12], np.zeros(3), state[15:18],
            linear_acceleration=state[21:24],
        )  # fmt: skip
        covariance = np.diag(np.full(PARAMETERS, _ANYWHERE))
        covariance[np.ix_(_TURNING, _TURNING)] = turned.known.error
        tied = np.zeros((PARAMETERS, ERRORS))
        tied[_TURNING] = turned.by_errors[BETWEEN.stop :] @ self.errors.covariance
        return _Foreseen(motion, covariance, tied)

    def _oddity(self) -> str:
        """Return in words what it has that the settings hardly allow for; empty: nothing."""
        said = [words(self.errors.mean[place]) for place, words in _WORDS if self._is_odd(place)]
        if self._former is not None:  # the delay may be another one since it is learned anew
            off = self.errors.time_offset - self._former.time_offset
            variance = self.errors.covariance[DELAY, DELAY] + self._former.covariance[DELAY, DELAY]
            if off**2 > _CERTAIN[1] * variance.item():
                said.append(f"its stamps stepped by {1e3 * abs(off):.0f} ms")
        return " and ".join(said)

    def _is_odd(self, place: slice) -> bool:
        """Return whether numbers are certainly not zero, and more than their deviation."""
        off, known = self.errors.mean[place], self.errors.covariance[place, place]
        certain = off @ np.linalg.solve(known, off) > _CERTAIN[len(off)]
        return bool(certain and np.mean(off**2) > self._before_all[place.start, place.start])


def _scale(off: Array) -> str:
    share = float(off[np.abs(off).argmax()])
    return f"it turns {100.0 * abs(share):.0f} % too {'fast' if share > 0.0 else 'slowly'}"


def _mount(off: Array) -> str:
    return f"its mount is {math.degrees(np.linalg.norm(off)):.0f} deg off"


def _delay(off: Array) -> str:
    return f"its stamps are {1e3 * abs(off[0]):.0f} ms {'early' if off[0] > 0.0 else 'late'}"


_WORDS = ((SCALE, _scale), (MOUNT, _mount), (DELAY, _delay))


def _swung(found: Estimate, turned: Rotated) -> float:
    """Return the squared size, in deviations, of a vibration that points see beside it."""
    if found.turn is None or not len(found.shake):
        return 0.0
    values, known = np.zeros((len(_ROWS), FUNCTIONS)), turned.known
    covariance = np.diag(np.tile(_PEAK * turned.swing, len(_ROWS)))
    late = np.zeros((len(_ROWS), 3))
    for k, tau in enumerate(_ROWS):
        shake_basis(tau, values[k], np.zeros(FUNCTIONS))
        late[k] = known.delay * late_at(tau, known.tau, known.rates, known.parabola)[0]
    seen = (values @ found.shake).ravel()
    by_shake = np.kron(values, np.eye(3))
    covariance += by_shake @ found.joint_covariance[PARAMETERS:, PARAMETERS:] @ by_shake.T
    covariance += np.outer(late, late)
    return float(seen @ np.linalg.solve(covariance, seen))


def _is_positive(joint: Array) -> bool:
    scale = np.sqrt(joint.diagonal())
    try:
        np.linalg.cholesky(joint / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return False
    return True


def changed(samples: ImuSamples, seconds: float) -> float:
    """Return the mean squared change of the rates of an axis (rad/s)^2 in so many s, of late."""
    times = 1e-9 * (samples.times_ns - samples.times_ns[-1])
    late = times >= times[0] + seconds
    late &= times >= -_LATELY
    if not late.any():
        return math.inf
    rates = samples.angular_velocity
    before = [np.interp(times[late] - seconds, times, rates[:, axis]) for axis in range(3)]
    return float(np.mean((rates[late] - np.transpose(before)) ** 2))


def without_gyro(prior: Prior | None, turn: GyroRotation) -> Prior | None:
    """Return the prediction of the camera alone, for a motion beside a known turn."""
    if prior is None:
        return None
    assert prior.motion is not None
    assert prior.covariance is not None
    covariance = prior.covariance.copy()
    covariance[_TURNING] = 0.0
    covariance[:, _TURNING] = 0.0
    covariance[np.ix_(_TURNING, _TURNING)] = turn.error
    still = replace(prior.motion, angular_velocity=np.zeros(3), angular_acceleration=np.zeros(3))
    return replace(prior, motion=still, covariance=covariance)
