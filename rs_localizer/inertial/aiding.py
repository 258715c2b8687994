# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A gyroscope beside a tracker: it predicts each frame, and its errors are estimated from it."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.gyro_rotation import GyroRotation
from rs_localizer.core.reasons import ImuReason
from rs_localizer.core.shutter import Motion
from rs_localizer.core.state import ANGULAR, ANGULAR_ACCELERATION, PARAMETERS, TURN, step_between
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.prior import Prior, state_in
from rs_localizer.inertial import turning
from rs_localizer.inertial.filter import RATE, GyroscopeFilter, Predicted
from rs_localizer.inertial.gravity import gravity_seen
from rs_localizer.inertial.gyroscope_noise import OFFSET_DEVIATION, InertialSettings
from rs_localizer.inertial.offset_search import OffsetSearch, Orientation
from rs_localizer.inertial.row_offset_likelihood import row_offset_likelihood
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.status import InertialStatus, Unused
from rs_localizer.inertial.turning import TurnBetween, TurnWithin
from rs_localizer.inertial.watch import GyroscopeWatch

# Of a step: what a gyroscope contradicts.
_SEEN = np.r_[TURN, ANGULAR]
# Squared Mahalanobis length of what a frame changes in the predicted rotation and turn rate; a
# chi-squared variable of six degrees of freedom exceeds this once in a million.
_MOST_SURPRISE = 38.0
# Points that fit with the gyroscope, beyond those that fit without it, that speak for it although
# it contradicts what the camera sees.
_BETTER_SHARE, _BETTER_COUNT = 1.05, 1
# Deviations of an offset that was found at once, as the filter takes them.
_WIDER = 3.0
# s: over which rates have changed as they will.
_LATELY = 0.1
# An offset is hardly known whose deviation is this part of what it is at first.
_HARDLY = 0.25

Found = tuple[Estimate | Failure, Prior | None]
# What a gyroscope measures.
_TURNING = np.r_[ANGULAR, ANGULAR_ACCELERATION]


@dataclass(frozen=True, slots=True, eq=False)
class Before:
    """The last frame with a pose, for a prediction."""

    middle_ns: int
    motion: Motion  # beside its known turn
    covariance: Array  # (18,18)
    added: Array  # (18,18) that the prediction gets, but for the rotation
    fading: float  # of accelerations, in readouts


@dataclass(frozen=True, slots=True, eq=False)
class GyroPrediction:
    """The gyroscope's knowledge of a frame."""

    middle_ns: int
    within: TurnWithin
    prior: Prior | None  # of the motion beside the turn
    predicted: Predicted | None  # the same with the gyroscope's parameters

    @property
    def turn(self) -> GyroRotation:
        return self.within.known

    def of(self, last: Estimate) -> Estimate:
        """The estimate that it makes of the last frame's."""
        assert self.predicted is not None
        motion, turn = self.predicted.motion, self.turn
        numbers = {each.name: getattr(motion, each.name) for each in fields(Motion)}
        numbers["angular_velocity"] = motion.angular_velocity + turn.rate
        numbers["angular_acceleration"] = motion.angular_acceleration + turn.change
        return last.with_joint_covariance(
            self.predicted.covariance, **numbers, shake=np.zeros((0, 3)), turn=turn
        )


class GyroscopeAid:
    """The gyroscope of one camera.

    Args:
        settings: what is known of it.
        readout_time: s, of the camera.
    """

    def __init__(self, settings: InertialSettings, readout_time: float) -> None:
        self._settings, self._readout_time = settings, readout_time
        self.filter = GyroscopeFilter(settings)
        self._watch = GyroscopeWatch(settings, self.filter)
        self._last_ns: int | None = None
        self._unused: Unused | None = Unused(ImuReason.LATE)  # in the last frame
        self._status: InertialStatus | None = None  # until it is asked for
        self._search = OffsetSearch() if settings.estimate_time_offset else None
        self._shaken = False  # in this frame, by the gyroscope
        self._stepped = False  # whether the search is one after a doubt

    @property
    def status(self) -> InertialStatus:
        """State of the gyroscope after the last frame."""
        if self._status is None:
            self._status = self._watch.status(self._unused)
        return self._status

    def reset(self) -> None:
        """Forget all frames."""
        self._status = None
        self.filter.reset()
        self._watch.reset()
        self._last_ns, self._stepped = None, False
        self._search = OffsetSearch() if self._settings.estimate_time_offset else None

    def snapshot(self) -> GyroscopeAid:
        """What :meth:`ahead` knows now: frames that come later do not change it."""
        there = copy(self)
        there.filter = copy(self.filter)
        return there

    def seek(
        self, camera: Camera, points: ArrayLike, pixels: ArrayLike, found: Estimate, middle_ns: int
    ) -> None:
        """Look for the time offset with one more frame: only where the camera vibrates one may err.

        Args:
            camera: with the lens by which the frame was found.
            points, pixels: (n,3) and (n,2) as they were localized.
            middle_ns: exposure of the middle row.
        """
        if not self._shaken or self._search is None or not self._search.wants():
            return
        sight = row_offset_likelihood(camera, points, pixels, found, middle_ns)
        if sight is None:
            return
        self._search.add(sight)
        offset = self._search.look(*self._watch.heard)
        if offset is not None:
            self._search, self._status, self._stepped = None, None, False
            if self.filter.contradicts(offset.time_offset, offset.deviation):
                self.filter.reset(offset.time_offset, _WIDER * offset.deviation)
                self._watch.take_up()

    def localize(
        self,
        samples: ImuSamples | None,
        middle_ns: int,
        before: Callable[[], Before | None],
        localized: Callable[[GyroPrediction | None], Found],
    ) -> Found:
        """Localize a frame with the gyroscope, or without it where that is better.

        Args:
            middle_ns: exposure of its middle row.
            before: gives the last frame; None: there is no track.
            localized: localizes the frame with what is foreseen, or with the camera alone; and the
                prior that it did so with.
        """
        self._status, self._shaken = None, False
        if self._last_ns is not None and middle_ns > self._last_ns:
            self.filter.walk(1e-9 * (middle_ns - self._last_ns))
        self._last_ns = middle_ns
        foreseen = self._foreseen(samples, middle_ns, before)
        if foreseen is None:
            self.filter.forget_motion()
            alone = localized(None)
            late = self._unused is not None and self._unused.reason is ImuReason.LATE
            if late and self._strayed(samples, middle_ns):
                self.filter.reset()
                self._contradicted(middle_ns, alone[0])
            else:
                self._compare(middle_ns, alone[0])
            return alone
        found = localized(foreseen)
        step = _step(foreseen, found[0])
        if step is not None and not (_contradicts(foreseen, step) or self.filter.strange):
            if self._learn(foreseen, found[0], step):
                return found
            self._unused = Unused(ImuReason.DOUBTED)
            self.filter.forget_motion()
            return localized(None)
        alone = localized(None)
        better = _better(found[0], alone[0])
        self._contradicted(middle_ns, None if better else alone[0])
        return found if better else alone

    def last_ns(self, samples: ImuSamples) -> int:
        """The last moment that samples cover, by the camera's clock."""
        return int(samples.times_ns[-1]) + round(1e9 * self.filter.errors.time_offset) - 1

    @property
    def agreed(self) -> bool:
        """Agreement of the last frame with the gyroscope."""
        return self._unused is None

    def ahead(self, samples: ImuSamples, middle_ns: int, last: Before) -> GyroPrediction | None:
        """Prediction of a moment after the last frame, as if it were a frame's.

        None unless samples cover it.
        """
        errors = self.filter.errors
        turn = turning.turn_within(samples, middle_ns, self._readout_time, errors)
        between = turning.turn_between(samples, last.middle_ns, middle_ns, errors)
        if turn is None or between is None:
            return None
        return self._predicted(last, between, turn, middle_ns)

    def _foreseen(
        self, samples: ImuSamples | None, middle_ns: int, before: Callable[[], Before | None]
    ) -> GyroPrediction | None:
        """Prediction of a frame before its points; None: the camera has to go alone."""
        if samples is None or len(samples) == 0:
            self._unused = Unused(ImuReason.LATE)
            return None
        self._watch.hear(samples)
        if self._watch.dropped is not None:
            self._unused = self._watch.dropped
            return None
        turn = turning.turn_within(samples, middle_ns, self._readout_time, self.filter.errors)
        if turn is None:
            self._unused = Unused(ImuReason.LATE)
            return None
        self._shaken = turn.known.roughness > turning.MOST_ROUGH
        last = before()
        if last is not None:
            errors = self.filter.errors
            between = turning.turn_between(samples, last.middle_ns, middle_ns, errors)
            if between is not None:
                return self._predicted(last, between, turn, middle_ns)
        self.filter.forget_motion()
        return GyroPrediction(middle_ns, turn, self._gravity(samples, middle_ns), None)

    def _strayed(self, samples: ImuSamples | None, middle_ns: int) -> bool:
        """True if samples do not cover a frame for an offset that is hardly known.

        Such a one would never be tried again: a gyroscope that shows something else leads there.
        """
        errors = self.filter.errors
        if samples is None or errors.covariance[3, 3] < (_HARDLY * OFFSET_DEVIATION) ** 2:
            return False
        fresh = GyroscopeFilter(self._settings).errors
        return turning.turn_within(samples, middle_ns, self._readout_time, fresh) is not None

    def _gravity(self, samples: ImuSamples, middle_ns: int) -> Prior | None:
        up = self._settings.gravity_in_map
        seen = None if up is None else gravity_seen(samples, middle_ns, self.filter.errors)
        if up is None or seen is None:
            return None
        return Prior(gravity=seen[0], gravity_deviation=seen[1], gravity_in_map=up)

    def _predicted(
        self, last: Before, between: TurnBetween, within: TurnWithin, middle_ns: int
    ) -> GyroPrediction:
        readouts = 1e-9 * (middle_ns - last.middle_ns) / self._readout_time
        predicted = self.filter.predict(
            last.motion, last.covariance, between, within, readouts, last.fading
        )
        predicted = predicted.spread(last.added)
        prior = Prior(motion=predicted.motion, covariance=predicted.covariance)
        return GyroPrediction(middle_ns, within, prior, predicted)

    def _learn(self, foreseen: GyroPrediction, found: Estimate | Failure, step: Array) -> bool:
        """Take in a frame that agrees with the gyroscope; whether the time offset does, too."""
        assert found
        self._unused = None
        if self._shaken and self._stepped and self._search is not None and self._search.hopes:
            return False  # of a vibration whose phase nobody knows, turns say nothing
        self._watch.judge(False, None)
        posterior = found.joint_covariance[:PARAMETERS, :PARAMETERS]
        possible = True
        if foreseen.predicted is not None:
            possible = self.filter.update(foreseen.predicted, step, posterior)
        else:
            self.filter.begin(foreseen.within, step[RATE], posterior)
        (delay, variance), unit = found.delay, self._readout_time
        if self.filter.hear_delay(unit * delay, unit**2 * variance) and possible:
            return True
        self._doubt()
        return False

    def _doubt(self) -> None:
        """Take the time offset for less well known, and look for it again.

        Of all that a gyroscope is off by, only its stamps change at once, with the clock of one of
        the two.
        """
        if self._settings.estimate_time_offset:
            self.filter.doubt_offset()
            self._search = self._search or OffsetSearch(self.filter.errors.time_offset)
            self._stepped = True

    def _contradicted(self, middle_ns: int, alone: Estimate | Failure | None) -> None:
        """Take in a frame that does not agree, with the result of the camera alone if it counts."""
        self.filter.forget_motion()
        if alone:
            self._doubt()
        searching = self._shaken and self._search is not None and self._search.is_young
        if not searching:  # else the offset may be all that is wrong
            self._watch.judge(bool(alone), _oriented(middle_ns, alone) if alone else None)
        self._unused = (self._watch.dropped or Unused(ImuReason.DOUBTED)) if alone else None

    def _compare(self, middle_ns: int, alone: Estimate | Failure) -> None:
        """Compare a gyroscope that was dropped with what the camera sees without it."""
        if alone and self._watch.dropped is not None:
            self._watch.judge(False, _oriented(middle_ns, alone))


def changed(samples: ImuSamples, seconds: float) -> float:
    """Mean squared change of each axis' turn rate (rad/s)^2 in so many s, of late."""
    times = 1e-9 * (samples.times_ns - samples.times_ns[-1])
    late = times >= times[0] + seconds
    late &= times >= -_LATELY
    if not late.any():
        return math.inf
    rates = samples.angular_velocity
    before = [np.interp(times[late] - seconds, times, rates[:, axis]) for axis in range(3)]
    return float(np.mean((rates[late] - np.transpose(before)) ** 2))


def _better(found: Estimate | Failure, alone: Estimate | Failure) -> bool:
    """True if a result with a gyroscope that contradicts the camera is the better one."""
    if not alone or not found:
        return bool(found) or not alone
    fewer = _BETTER_SHARE * np.count_nonzero(alone.inliers) + _BETTER_COUNT
    return bool(np.count_nonzero(found.inliers) > fewer)


def _oriented(middle_ns: int, found: Estimate) -> Orientation:
    deviation = np.sqrt(np.trace(found.covariance[TURN, TURN]) / 3.0)
    return Orientation(middle_ns, found.rotation, float(deviation))


def _step(foreseen: GyroPrediction, found: Estimate | Failure) -> Array | None:
    """The step (18,) from what was foreseen to an estimate, beside the known turn.

    None where there is no estimate, or none near the prediction. Without a prediction only what the
    gyroscope leaves counts.
    """
    if not found:
        return None
    motion, origin = found.without_gyro(), np.zeros(3)
    if foreseen.predicted is None:
        step = np.zeros(PARAMETERS)
        step[ANGULAR] = motion.angular_velocity
        step[ANGULAR_ACCELERATION] = motion.angular_acceleration
        return step
    if not found.tracked:
        return None
    return step_between(state_in(foreseen.predicted.motion, origin), state_in(motion, origin))


def _contradicts(foreseen: GyroPrediction, step: Array) -> bool:
    """True if a frame moved what the gyroscope says by more than its covariance allows."""
    if foreseen.predicted is None:
        moved, covariance = step[ANGULAR], foreseen.turn.error[:3, :3]
    else:
        moved, covariance = step[_SEEN], foreseen.predicted.covariance[np.ix_(_SEEN, _SEEN)]
    try:
        distance = moved @ np.linalg.solve(covariance, moved)
    except np.linalg.LinAlgError:
        return True
    return not distance <= _MOST_SURPRISE


def without_gyro(prior: Prior | None, turn: GyroRotation) -> Prior | None:
    """Prediction of the camera alone, for a motion beside a known turn."""
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
