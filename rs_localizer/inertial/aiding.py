"""A gyroscope beside a tracker: it foresees each frame, and learns from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.known_turn import KnownTurn
from rs_localizer.core.shutter import Motion
from rs_localizer.core.state import PARAMETERS
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.prior import Prior, state_in
from rs_localizer.estimation.refine import step_between
from rs_localizer.inertial import turning
from rs_localizer.inertial.filter import RATE, GyroscopeFilter, Predicted
from rs_localizer.inertial.gravity import gravity_seen
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.settings import InertialSettings
from rs_localizer.inertial.status import Alone, InertialStatus
from rs_localizer.inertial.turning import TurnWithin
from rs_localizer.inertial.watch import Believed, GyroscopeWatch, contradicts

# Points that fit without the gyroscope, beyond those that fit with it, that speak against it.
_BETTER_SHARE, _BETTER_COUNT = 1.05, 1


@dataclass(frozen=True, slots=True, eq=False)
class Before:
    """The last frame with a pose, for a prediction."""

    middle_ns: int
    motion: Motion  # beside its known turn
    covariance: Array  # (18,18)
    added: Array  # (18,18) that the prediction gets, but for the rotation
    fading: float  # of accelerations, in readouts


@dataclass(frozen=True, slots=True, eq=False)
class Foreseen:
    """What the gyroscope says of a frame."""

    middle_ns: int
    within: TurnWithin
    prior: Prior | None  # of the motion beside the turn
    predicted: Predicted | None  # the same with the gyroscope's parameters

    @property
    def turn(self) -> KnownTurn:
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
        self.status = InertialStatus(Alone.NO_SAMPLES)

    def reset(self) -> None:
        """Forget all frames."""
        self.filter.reset()
        self._watch.reset()
        self._last_ns = None

    def foresee(
        self, samples: ImuSamples | None, middle_ns: int, before: Before | None, prior: Prior | None
    ) -> Foreseen | None:
        """What is known of a frame before its points; None: the camera has to go alone.

        Args:
            middle_ns: exposure of its middle row.
            before: the last frame; None: there is no track.
            prior: what the camera alone foresees.
        """
        if self._last_ns is not None and middle_ns > self._last_ns:
            self.filter.walk(1e-9 * (middle_ns - self._last_ns))
        self._last_ns = middle_ns
        if before is None:
            self.filter.forget_motion()
        if samples is None or len(samples) == 0:
            self._alone(Alone.NO_SAMPLES)
            return None
        self._watch.hear(samples)
        if self._watch.dropped is not Alone.NONE:
            self._alone(self._watch.dropped)
            return None
        turn = turning.turn_within(samples, middle_ns, self._readout_time, self.filter.errors)
        if turn is None:
            self._alone(Alone.NOT_COVERED)
            return None
        if before is None or prior is None:
            return Foreseen(middle_ns, turn, self._gravity(samples, middle_ns), None)
        predicted = self._predicted(samples, middle_ns, before, prior, turn)
        prior = replace(prior, motion=predicted.motion, covariance=predicted.covariance)
        return Foreseen(middle_ns, turn, prior, predicted)

    def _alone(self, why: Alone) -> None:
        self.filter.forget_motion()
        self.status = self._watch.status(why)

    def _gravity(self, samples: ImuSamples, middle_ns: int) -> Prior | None:
        up = self._settings.gravity_in_map
        seen = None if up is None else gravity_seen(samples, middle_ns, self.filter.errors)
        if up is None or seen is None:
            return None
        return Prior(gravity=seen[0], gravity_deviation=seen[1], gravity_in_map=up)

    def _predicted(
        self, samples: ImuSamples, middle_ns: int, before: Before, prior: Prior, turn: TurnWithin
    ) -> Predicted:
        errors = self.filter.errors
        between = turning.turn_between(samples, before.middle_ns, middle_ns, errors)
        if between is None:
            return self._predicted_by_camera(prior, turn)
        predicted = self.filter.predict(
            before.motion,
            before.covariance,
            between,
            turn,
            1e-9 * (middle_ns - before.middle_ns) / self._readout_time,
            before.fading,
        )
        return replace(predicted, covariance=predicted.covariance + before.added)

    def _predicted_by_camera(self, prior: Prior, turn: TurnWithin) -> Predicted:
        """The camera's prediction, beside the turn within the frame."""
        assert prior.motion is not None
        assert prior.covariance is not None
        motion = replace(
            prior.motion, angular_velocity=np.zeros(3), angular_acceleration=np.zeros(3)
        )
        covariance = prior.covariance.copy()
        covariance[RATE] = 0.0
        covariance[:, RATE] = 0.0
        covariance[np.ix_(RATE, RATE)] = turn.known.error
        with_parameters = np.zeros((PARAMETERS, turning.PARAMETERS))
        with_parameters[RATE] = turn.by_parameters @ self.filter.errors.covariance
        return Predicted(motion, covariance, with_parameters)

    def doubtful(self, foreseen: Foreseen, found: Estimate | Failure) -> bool:
        """Whether a frame should be tried without the gyroscope."""
        if not found or (foreseen.predicted is not None and not found.tracked):
            return True
        return self._contradicts(foreseen, found)

    def _contradicts(self, foreseen: Foreseen, found: Estimate) -> bool:
        if foreseen.predicted is None:
            covariance = np.eye(PARAMETERS)
            covariance[np.ix_(RATE, RATE)] = foreseen.turn.error
            step = np.zeros(PARAMETERS)
            step[RATE] = _left(found)
            return contradicts(step, covariance)
        return contradicts(_step(foreseen.predicted, found), foreseen.predicted.covariance)

    def learn(
        self, foreseen: Foreseen, found: Estimate | Failure, alone: Estimate | Failure | None
    ) -> Estimate | Failure:
        """Take in a frame; the better of its results, with the gyroscope and without.

        Args:
            alone: without the gyroscope; None where there was no doubt.
        """
        better = _better(found, alone)
        if not better:
            self.filter.forget_motion()
            self.status = self._watch.status(Alone.NONE)
            return better
        if better.turn is None:
            self.filter.forget_motion()
            self._watch.judge(True, _believed(foreseen.middle_ns, better))
            dropped = self._watch.dropped
            self.status = self._watch.status(Alone.DOUBTED if dropped is Alone.NONE else dropped)
            return better
        contradicted = self._contradicts(foreseen, better)
        self._watch.judge(contradicted, None)
        posterior = better.joint_covariance[:PARAMETERS, :PARAMETERS]
        delay, variance = better.delay
        if contradicted:
            self.filter.forget_motion()
        elif foreseen.predicted is not None and better.tracked:
            step = _step(foreseen.predicted, better)
            self.filter.update(foreseen.predicted, step, posterior)
        else:
            self.filter.begin(foreseen.within, _left(better), posterior)
        if not contradicted:
            readout_time = self._readout_time
            self.filter.hear_delay(readout_time * delay, readout_time**2 * variance)
        self.status = self._watch.status(Alone.NONE)
        return better

    def compare(self, middle_ns: int, alone: Estimate | Failure) -> None:
        """Compare a gyroscope that was dropped with what the camera sees without it."""
        if alone and self._watch.dropped is not Alone.NONE:
            self._watch.judge(False, _believed(middle_ns, alone))


def _better(found: Estimate | Failure, alone: Estimate | Failure | None) -> Estimate | Failure:
    if not alone:  # Also where it was not asked for.
        return found
    if not found:
        return alone
    most = _BETTER_SHARE * np.count_nonzero(found.inliers) + _BETTER_COUNT
    return alone if np.count_nonzero(alone.inliers) > most else found


def _believed(middle_ns: int, found: Estimate) -> Believed:
    return Believed(middle_ns, found.rotation, found.covariance[:3, :3])


def _step(predicted: Predicted, found: Estimate) -> Array:
    """The step (18,) from a prediction to an estimate, both beside the known turn."""
    origin = np.zeros(3)
    return step_between(state_in(predicted.motion, origin), state_in(found.beside_turn(), origin))


def _left(found: Estimate) -> Array:
    """Rate and its change (6,) that the points left beside the known turn."""
    motion = found.beside_turn()
    return np.concatenate([motion.angular_velocity, motion.angular_acceleration])
