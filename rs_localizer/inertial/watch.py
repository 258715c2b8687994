"""Whether a gyroscope can be believed, by what the camera sees."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.simd.jit import kernel
from rs_localizer.estimation.refine import inverted
from rs_localizer.inertial.filter import GyroscopeFilter
from rs_localizer.inertial.mounting import fit_mounting
from rs_localizer.inertial.offset import CameraTurn, fit_offset
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.settings import InertialSettings
from rs_localizer.inertial.status import Alone, InertialStatus
from rs_localizer.inertial.turning import turn_between

# Squared Mahalanobis length of what a frame changes in the predicted rotation and turn rate; a
# chi-squared variable of six degrees of freedom exceeds this once in a million.
_MOST_SURPRISE = 38.0
# So many of the last frames that contradict the gyroscope are no chance.
_WATCHED, _CONTRADICTIONS = 12, 6
# Turns of the camera that are kept to find out why, and how often that is tried (frames).
_KEPT, _TRY_EVERY = 90, 15
_LONGEST_PAIR_NS = 200_000_000
_MEMORY_NS = 4_000_000_000
# Turns smaller than this, in deviations, say nothing.
_TELLING = 5.0
# Of the camera's turns and the gyroscope's, as a part of them, beyond the deviations.
_ALLOWED = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Believed:
    """A frame with a pose, as the gyroscope is compared with it."""

    middle_ns: int
    rotation: Array  # (3,3) camera_from_map
    covariance: Array  # (3,3) of it, rad^2


class GyroscopeWatch:
    """Drops a gyroscope that contradicts the camera, finds out why, and takes it up again."""

    def __init__(self, settings: InertialSettings, filter_: GyroscopeFilter) -> None:
        self._settings, self._filter = settings, filter_
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.dropped = Alone.NONE
        self.angle = 0.0
        self._contradictions: deque[bool] = deque(maxlen=_WATCHED)
        self._turns: deque[CameraTurn] = deque(maxlen=_KEPT)
        self._last: Believed | None = None
        self._samples: deque[tuple[IntArray, Array]] = deque()
        self._untried = 0

    def hear(self, samples: ImuSamples) -> None:
        """Keep the samples that are new."""
        newest = int(self._samples[-1][0][-1]) if self._samples else -(2**63)
        first = int(samples.times_ns.searchsorted(newest, "right"))
        if first < len(samples):
            self._samples.append((samples.times_ns[first:], samples.angular_velocity[first:]))
        while self._samples and self._samples[0][0][-1] < samples.times_ns[-1] - _MEMORY_NS:
            self._samples.popleft()

    @property
    def heard(self) -> tuple[IntArray, Array]:
        """Times (n,) in ns and rates (n,3) of the last seconds' samples."""
        if not self._samples:
            return np.zeros(0, np.int64), np.zeros((0, 3))
        times, rates = zip(*self._samples, strict=True)
        return np.concatenate(times), np.concatenate(rates)

    def judge(self, contradicts: bool, frame: Believed | None) -> None:
        """Take in a frame.

        Args:
            contradicts: the gyroscope.
            frame: its pose, if it was found without the gyroscope.
        """
        self._contradictions.append(contradicts)
        if frame is not None:
            self._follow(frame)
        if self.dropped is Alone.NONE:
            if sum(self._contradictions) >= _CONTRADICTIONS:
                self.dropped, self._untried = Alone.DISAGREES, 0
                self._filter.reset()  # what it learned of such a gyroscope is nothing
            return
        self._untried += 1
        if self._untried >= _TRY_EVERY:
            self._untried = 0
            self._explain()

    def _follow(self, frame: Believed) -> None:
        last, self._last = self._last, frame
        if last is None or not 0 < frame.middle_ns - last.middle_ns <= _LONGEST_PAIR_NS:
            return
        turn = frame.rotation @ last.rotation.T
        deviation = np.sqrt((np.trace(frame.covariance) + np.trace(last.covariance)) / 3.0)
        self._turns.append(CameraTurn(last.middle_ns, frame.middle_ns, turn, float(deviation)))

    def _explain(self) -> None:
        """Find a time offset that makes the two agree, or say that the mounting does not."""
        if not self._samples:
            return
        times, rates = self.heard
        fit = fit_offset(times, rates, self._turns)
        if fit is not None and fit.explains and self._settings.estimate_time_offset:
            self._filter.reset(fit.time_offset, 2.0 * fit.deviation)
            self.take_up()
            return
        shown, seen = self._compared(ImuSamples(times, rates))
        if len(seen) and np.sum((seen - shown) ** 2) < _ALLOWED * np.sum(seen**2):
            self.take_up()
            return
        mounting = fit_mounting(shown, seen) if len(seen) else None
        if mounting is not None and mounting.explains:
            self.dropped, self.angle = Alone.TURNED, mounting.angle
        else:
            self.dropped, self.angle = Alone.DISAGREES, 0.0

    def take_up(self) -> None:
        """Believe it again."""
        self.dropped, self.angle = Alone.NONE, 0.0
        self._contradictions.clear()

    def _compared(self, samples: ImuSamples) -> tuple[Array, Array]:
        """Turns (k,3) of gyroscope and camera, as rotation vectors; those that say something."""
        shown, seen = [], []
        for turn in self._turns:
            camera = so3.log(np.ascontiguousarray(turn.rotation.T))
            between = turn_between(samples, turn.from_ns, turn.to_ns, self._filter.errors)
            if between is not None and np.linalg.norm(camera) > _TELLING * turn.deviation:
                shown.append(so3.log(between.rotation.T.copy()))
                seen.append(camera)
        return np.array(shown).reshape(-1, 3), np.array(seen).reshape(-1, 3)

    def status(self, alone: Alone) -> InertialStatus:
        """What to tell."""
        errors = self._filter.errors
        *biases, offset = errors.covariance.diagonal().tolist()
        return InertialStatus(
            alone,
            errors.bias,
            math.sqrt(sum(biases) / len(biases)),
            errors.time_offset,
            math.sqrt(offset),
            self.angle,
        )


@kernel
def contradicts(step: Array, covariance: Array, places: IntArray) -> bool:
    """Whether a frame moved what stands at these places by more than its covariance allows."""
    count = len(places)
    block = np.empty((count, count))
    for i in range(count):
        for j in range(count):
            block[i, j] = covariance[places[i], places[j]]
    information = inverted(block)
    distance = 0.0
    for i in range(count):
        for j in range(count):
            distance += step[places[i]] * information[i, j] * step[places[j]]
    return not distance <= _MOST_SURPRISE
