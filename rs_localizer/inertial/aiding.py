# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A gyroscope beside a tracker: it predicts each frame, and its errors are estimated from it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.gyro_rotation import GyroRotation
from rs_localizer.core.rate_spline import multiplied, rotations_at_knots, spline, turns_at
from rs_localizer.core.scales import Scales
from rs_localizer.core.shutter import Motion
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.state import ANGULAR, ANGULAR_ACCELERATION, PARAMETERS, TURN, step_between
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.prior import Prior, state_in
from rs_localizer.inertial import turning
from rs_localizer.inertial.filter import RATE, GyroscopeFilter, Predicted
from rs_localizer.inertial.gravity import gravity_seen
from rs_localizer.inertial.row_offset_likelihood import RowOffsetLikelihood
from rs_localizer.inertial.samples import ImuSamples, span_of
from rs_localizer.inertial.settings import (
    BIAS_DEVIATION,
    OFFSET_DEVIATION,
    SCALE_DEVIATION,
    InertialSettings,
)
from rs_localizer.inertial.turning import TurnBetween, TurnWithin
from rs_localizer.inertial.watch import Alone, Believed, GyroscopeWatch, InertialStatus, contradicts

# Offsets to try, s: three standard deviations; a vibration of 120 Hz has 16 steps in a cycle.
_FARTHEST, _STEP = 3.0 * OFFSET_DEVIATION, 5e-4
_EACH = round(_FARTHEST / _STEP)
_OFFSETS: Array = _STEP * np.arange(-_EACH, _EACH + 1, dtype=np.float64)
# Offsets farther than this from the best one (s) are another mode; it is no longer possible when it
# costs so much more (odds of a million to one).
_OTHER, _CLEARLY = 3e-3, 28.0
_FEWEST = 6  # frames
_AGREE = 4.0  # squared errors per degree of freedom of turns that agree
# Samples on both sides, s; frames farther apart than this are not connected by their turn.
_AROUND_NS, _LONGEST_NS = 10_000_000, 500_000_000
# A frame says nothing where the gyroscope's rates differ by less than this, rad/s.
_LEAST_SWING = 0.03
# After so many frames without a decision only some are looked at: nothing new is to be seen.
_PATIENCE, _LATER = 60, 10
# What orientations are off by beside their noise, rad: the model, and what neighbours share.
_LEAST_DEVIATION = 5e-4
# Costs of a frame are worth this part: errors of neighbouring frames are alike.
_WORTH = 0.5
_LEAST_VARIANCE = 0.05  # of errors, as a part of what the estimate left
# Precisions of what orientations leave free: the first of them, bias (rad/s), scales.
_LEFT = np.repeat([1e-9, BIAS_DEVIATION**-2, SCALE_DEVIATION**-2], 3)


@dataclass(frozen=True, slots=True)
class FoundOffset:
    """The one offset that is left."""

    time_offset: float  # s, to be added to the times of the samples
    deviation: float  # s


class OffsetSearch:
    """The time offset of a gyroscope from nothing: all offsets are kept until one is left.

    A vibration tells the offset within a frame to a tenth of a millisecond, but for whole periods
    of it. Which of them it is, the slow part of the motion tells: at the right offset the gyroscope
    carries the orientations of all frames into one another. Neither is linear beyond some
    milliseconds, so that a filter may lock on to a wrong period. Here each offset of a grid is
    supposed in turn, and its cost, twice the negative log-likelihood, summed over the frames:

    * of the rows, what the motion that is best beside the turn of this offset leaves of the errors,
      as in :mod:`rs_localizer.estimation.result`;
    * of the orientations ``R``, what a first orientation, a bias and the scales of the gyroscope
      leave of ``log(G^T R)``, with the turn ``G`` since the first frame (linear least squares; the
      normal matrix is the same for all offsets).

    The search ends when no other mode is left. What follows is the filter's.

    Args:
        about: s, the offset in the middle of those that are tried.
    """

    def __init__(self, about: float = 0.0) -> None:
        self._about = about
        self._waiting: deque[RowOffsetLikelihood] = deque()
        self._costs = (_OFFSETS / OFFSET_DEVIATION) ** 2  # of rows, and what is assumed
        self._closed = np.zeros(len(_OFFSETS))  # of orientations in chains that have ended
        self._frames = self._seen = 0
        self._begin(None)

    def _begin(self, sight: RowOffsetLikelihood | None) -> None:
        """Begin with orientations anew; what the former ones said is kept."""
        self._before_ns = None if sight is None else sight.middle_ns
        self._turned = np.eye(3)  # camera_then_from_camera_at_the_beginning, without an offset
        self._by_gyroscope = np.zeros((3, 6))  # of that, by bias and scales
        self._normal = np.diag(_LEFT)
        self._slopes = np.zeros((len(_OFFSETS), 9))
        self._squares = np.zeros(len(_OFFSETS))
        self._first = None if sight is None else sight.rotation

    @property
    def hopes(self) -> bool:
        """Whether it has not looked at frames for long in vain."""
        return self._seen < _PATIENCE

    def wants(self) -> bool:
        """Whether the next frame is to be looked at."""
        self._seen += 1
        return self._seen < _PATIENCE or self._seen % _LATER == 0

    def add(self, sight: RowOffsetLikelihood) -> None:
        """A frame; it is looked at when there are samples for all offsets."""
        self._waiting.append(sight)

    def look(self, times_ns: IntArray, rates: Array) -> FoundOffset | None:
        """Look at the frames whose samples have come; the offset if it is found.

        Args:
            times_ns: (n,) of the last seconds' samples.
            rates: (n,3) rad/s, camera axes, as they were measured.
        """
        looked = False
        while self._waiting and self._take(self._waiting[0], times_ns, rates):
            self._waiting.popleft()
            looked = True
        return self._decided() if looked and self._frames >= _FEWEST else None

    def _take(self, sight: RowOffsetLikelihood, times_ns: IntArray, rates: Array) -> bool:
        """Take in a frame; False: its samples may yet come."""
        here_ns = sight.middle_ns - round(1e9 * self._about)
        reach = round(1e9 * (float(np.abs(sight.rows).max()) + _FARTHEST)) + _AROUND_NS
        if not len(times_ns) or times_ns[-1] < here_ns + reach:
            return False
        before_ns = self._before_ns
        if before_ns is not None and not 0 < sight.middle_ns - before_ns <= _LONGEST_NS:
            self._close()
            before_ns = None
        since_ns = here_ns - reach
        if before_ns is not None:
            since_ns = min(since_ns, here_ns - (sight.middle_ns - before_ns) - _AROUND_NS)
        first, last = np.searchsorted(times_ns, [since_ns, here_ns + reach])
        if first == 0 or not _is_whole(times_ns[first - 1 : last + 1]):
            self._close()
            return True
        times = np.asarray(1e-9 * (times_ns[first - 1 : last + 1] - here_ns), np.float64)
        part = np.ascontiguousarray(rates[first - 1 : last + 1])
        cubics = spline(times, part)
        knots = rotations_at_knots(times, cubics)
        if before_ns is None:
            self._close()
            self._begin(sight)
        else:
            self._carry(times, cubics, knots, 1e-9 * (sight.middle_ns - before_ns))
            self._before_ns = sight.middle_ns
        if np.ptp(part, axis=0).max() > _LEAST_SWING:
            self._weigh(sight, times, cubics, knots)
        return True

    def _weigh(self, sight: RowOffsetLikelihood, times: Array, cubics: Array, knots: Array) -> None:
        """Add what a frame says to the costs."""
        assert self._first is not None
        self._frames += 1
        costs, steps = _row_costs(
            sight.errors, sight.by_turn, sight.base, sight.to_rotation, sight.rows, sight.turned,
            times, cubics, knots, _OFFSETS,
        )  # fmt: skip
        variance = max(float(costs.min()) / (2 * len(sight.errors) - 18), _LEAST_VARIANCE)
        self._costs += _WORTH * costs / variance
        middles, _ = turns_at(-_OFFSETS, times, cubics, knots)
        left = _left(middles, steps, self._turned, sight.rotation, self._first)
        design = np.hstack([np.eye(3), self._by_gyroscope])
        weight = _WORTH / (variance * sight.deviation**2 + _LEAST_DEVIATION**2)
        self._normal += weight * design.T @ design
        self._slopes += weight * left @ design
        self._squares += weight * np.einsum("gi,gi->g", left, left)

    def _carry(self, times: Array, cubics: Array, knots: Array, seconds: float) -> None:
        """From the last frame to this one: the turn, and what it is by bias and scales."""
        wanted = np.linspace(-seconds, 0.0, 9)
        turns, shown = turns_at(0.5 * (wanted[1:] + wanted[:-1]), times, cubics, knots)
        (then,), _ = turns_at(wanted[:1], times, cubics, knots)
        # In the axes of the beginning: a rate beside the one shown turns the camera by its way.
        here = turns @ then.T @ self._turned
        step = seconds / len(turns)
        self._by_gyroscope[:, :3] += step * np.einsum("nji->ij", here)
        self._by_gyroscope[:, 3:] += step * np.einsum("nji,nj->ij", here, shown)
        self._turned = then.T @ self._turned

    def _open(self) -> Array:
        """Costs of the orientations in this chain."""
        solved = np.linalg.solve(self._normal, self._slopes.T)
        costs: Array = self._squares - np.einsum("gi,ig->g", self._slopes, solved)
        return costs

    def _close(self) -> None:
        """Keep what a chain of orientations said."""
        self._closed += self._open()
        self._begin(None)

    def _decided(self) -> FoundOffset | None:
        turns = self._closed + self._open()
        costs = self._costs + turns
        best = int(np.argmin(costs))
        # One that is not on this body, or turned on it, agrees nowhere.
        if turns[best] > _AGREE * 3.0 * _WORTH * self._frames:
            return None
        far = np.abs(_OFFSETS - _OFFSETS[best]) > _OTHER
        if not 0 < best < len(costs) - 1 or np.any(costs[far] < costs[best] + _CLEARLY):
            return None
        before, at, after = costs[best - 1 : best + 2]
        bend = before - 2.0 * at + after
        if not bend > 0.0:
            return None
        shift = 0.5 * _STEP * (before - after) / bend
        deviation = _STEP * np.sqrt(2.0 / bend)
        return FoundOffset(self._about + float(_OFFSETS[best] + shift), float(deviation))


def warm_up() -> None:
    """Compile the kernels, or load them from the cache."""
    still, rows = np.tile(np.eye(3), (2, 1, 1)), np.zeros(2)
    base = np.zeros((2, 2, PARAMETERS))
    times = np.arange(-4.0, 5.0)
    cubics = spline(times, np.zeros((9, 3)))
    knots = rotations_at_knots(times, cubics)
    _row_costs(
        np.zeros((2, 2)), np.zeros((2, 2, 3)), base, np.zeros((3, PARAMETERS)), rows, still,
        times, cubics, knots, rows,
    )  # fmt: skip


def _is_whole(times_ns: IntArray) -> bool:
    steps = np.diff(times_ns)
    return len(steps) > 3 and bool(steps.max() < 2.5 * np.median(steps))


@kernel
def _row_costs(
    errors: Array, by_turn: Array, base: Array, to_rotation: Array, rows: Array, turned: Array,
    times: Array, cubics: Array, knots: Array, offsets: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Cost (k,) of each offset by the rows, and the turn (k,3) of the middle row beside it."""
    count, parameters = len(errors), base.shape[2]
    costs, steps = np.zeros(len(offsets)), np.zeros((len(offsets), 3))
    along, turn = np.empty(parameters), np.empty(3)
    for place in range(len(offsets)):
        middle, _ = turns_at(np.array([-offsets[place]]), times, cubics, knots)
        there, _ = turns_at(rows - offsets[place], times, cubics, knots)
        back = middle[0].T.copy()
        along[:] = 0.0
        for i in range(count):
            supposed = multiplied(there[i], back)
            off = multiplied(supposed.T.copy(), turned[i])
            turn[0] = 0.5 * (off[2, 1] - off[1, 2])
            turn[1] = 0.5 * (off[0, 2] - off[2, 0])
            turn[2] = 0.5 * (off[1, 0] - off[0, 1])
            for row in range(2):
                error = errors[i, row]
                for k in range(3):
                    error += by_turn[i, row, k] * turn[k]
                costs[place] += error * error
                for k in range(parameters):
                    along[k] += base[i, row, k] * error
        for k in range(parameters):
            costs[place] -= along[k] * along[k]
            for axis in range(3):
                steps[place, axis] -= to_rotation[axis, k] * along[k]
    return costs, steps


def _left(middles: Array, steps: Array, turned: Array, rotation: Array, first: Array) -> Array:
    """What is left (k,3) rad of a camera's turn since the first frame beside the gyroscope's.

    In the axes of the first frame, of each offset.
    """
    # The gyroscope's turn, later or earlier, takes the camera back to the first frame.
    back = np.swapaxes(middles @ turned, 1, 2)
    off = back @ rotation @ first.T
    own = np.stack([off[:, 2, 1] - off[:, 1, 2], off[:, 0, 2] - off[:, 2, 0],
                    off[:, 1, 0] - off[:, 0, 1]], axis=1)  # fmt: skip
    left: Array = -0.5 * own + np.einsum("gij,gj->gi", back, steps)
    return left


# Of a step: what a gyroscope contradicts.
_SEEN = np.r_[TURN, ANGULAR]
_FIRST = np.arange(3)
# Points that fit with the gyroscope, beyond those that fit without it, that speak for it although
# it contradicts what the camera sees.
_BETTER_SHARE, _BETTER_COUNT = 1.05, 1
# Deviations of an offset that was found at once, as the filter takes them.
_WIDER = 3.0

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
    scales: Scales  # as of a :class:`Prior`


@dataclass(frozen=True, slots=True, eq=False)
class GyroPrediction:
    """What the gyroscope says of a frame."""

    middle_ns: int
    within: TurnWithin
    prior: Prior | None  # of the motion beside the turn
    predicted: Predicted | None  # the same with the gyroscope's parameters

    @property
    def turn(self) -> GyroRotation:
        return self.within.known


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
        self._state = Alone.NO_SAMPLES
        self._status: InertialStatus | None = None  # until it is asked for
        self._search = OffsetSearch() if settings.estimate_time_offset else None
        self._shaken = False  # in this frame, by the gyroscope
        self._stepped = False  # whether the search is one after a doubt

    def warm_up(self) -> None:
        """Compile every kernel that frames may need, or load it from the cache."""
        times = np.arange(-60, 30) * 2_000_000
        samples = ImuSamples(times, np.zeros((len(times), 3)))
        filter_ = GyroscopeFilter(self._settings)
        within = turning.turn_within(samples, 0, 0.02, filter_.errors)
        between = turning.turn_between(samples, -30_000_000, 0, filter_.errors)
        assert within is not None
        assert between is not None
        span_of(times, 0, 1)
        warm_up()
        within.known.at(0.0)
        contradicts(np.zeros(3), np.eye(3), _FIRST)
        still = Motion(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
        identity = np.eye(PARAMETERS)
        predicted = filter_.predict(still, identity, between, within, 1.0, 1.0)
        added = predicted.spread(identity)
        filter_.update(added, np.zeros(PARAMETERS), 0.5 * added.covariance)

    @property
    def status(self) -> InertialStatus:
        """What became of the gyroscope in the last frame."""
        if self._status is None:
            self._status = self._watch.status(self._state)
        return self._status

    def reset(self) -> None:
        """Forget all frames."""
        self._status = None
        self.filter.reset()
        self._watch.reset()
        self._last_ns, self._stepped = None, False
        self._search = OffsetSearch() if self._settings.estimate_time_offset else None

    def wants_sight(self) -> bool:
        """Whether this frame is to help in that: only where the camera vibrates one may err."""
        return self._shaken and self._search is not None and self._search.wants()

    def seek(self, sight: RowOffsetLikelihood | None) -> None:
        """Look for the time offset with one more frame."""
        if self._search is None or sight is None:
            return
        self._search.add(sight)
        found = self._search.look(*self._watch.heard)
        if found is not None:
            self._search, self._status, self._stepped = None, None, False
            if self.filter.contradicts(found.time_offset, found.deviation):
                self.filter.reset(found.time_offset, _WIDER * found.deviation)
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
            self._compare(middle_ns, alone[0])
            return alone
        found = localized(foreseen)
        step = _step(foreseen, found[0])
        if step is not None and not (_contradicts(foreseen, step) or self.filter.strange):
            if self._learn(foreseen, found[0], step):
                return found
            self._state = Alone.DOUBTED
            self.filter.forget_motion()
            return localized(None)
        alone = localized(None)
        better = _better(found[0], alone[0])
        self._contradicted(middle_ns, None if better else alone[0])
        return found if better else alone

    def _foreseen(
        self, samples: ImuSamples | None, middle_ns: int, before: Callable[[], Before | None]
    ) -> GyroPrediction | None:
        """What is known of a frame before its points; None: the camera has to go alone."""
        if samples is None or len(samples) == 0:
            self._state = Alone.NO_SAMPLES
            return None
        self._watch.hear(samples)
        if self._watch.dropped is not Alone.NONE:
            self._state = self._watch.dropped
            return None
        turn = turning.turn_within(samples, middle_ns, self._readout_time, self.filter.errors)
        if turn is None:
            self._state = Alone.NOT_COVERED
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
        prior = Prior(
            motion=predicted.motion,
            covariance=predicted.covariance,
            scales=last.scales,
        )
        return GyroPrediction(middle_ns, within, prior, predicted)

    def _learn(self, foreseen: GyroPrediction, found: Estimate | Failure, step: Array) -> bool:
        """Take in a frame that agrees with the gyroscope; whether the time offset does, too."""
        assert found
        self._state = Alone.NONE
        self._watch.judge(False, None)
        if self._shaken and self._stepped and self._search is not None and self._search.hopes:
            return False  # of a vibration whose phase nobody knows, turns say nothing
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
        self._watch.judge(bool(alone), _believed(middle_ns, alone) if alone else None)
        self._state = Alone.NONE
        if alone:
            dropped = self._watch.dropped
            self._state = Alone.DOUBTED if dropped is Alone.NONE else dropped

    def _compare(self, middle_ns: int, alone: Estimate | Failure) -> None:
        """Compare a gyroscope that was dropped with what the camera sees without it."""
        if alone and self._watch.dropped is not Alone.NONE:
            self._watch.judge(False, _believed(middle_ns, alone))


def _better(found: Estimate | Failure, alone: Estimate | Failure) -> bool:
    """Whether a result with a gyroscope that contradicts the camera is the better one."""
    if not alone or not found:
        return bool(found) or not alone
    fewer = _BETTER_SHARE * np.count_nonzero(alone.inliers) + _BETTER_COUNT
    return bool(np.count_nonzero(found.inliers) > fewer)


def _believed(middle_ns: int, found: Estimate) -> Believed:
    return Believed(middle_ns, found.rotation, found.covariance[:3, :3])


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
    if foreseen.predicted is None:
        return contradicts(step[ANGULAR], foreseen.turn.error, _FIRST)
    return contradicts(step, foreseen.predicted.covariance, _SEEN)


def without_gyro(prior: Prior | None, turn: GyroRotation) -> Prior | None:
    """What the camera alone predicts, for a motion beside a known turn."""
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
