# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Watch over a gyroscope: it is believed as long as the camera agrees.

One that contradicts it in many frames is dropped, until the two agree again, or another offset of
its stamps makes them agree.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.reasons import ImuReason
from rs_localizer.inertial.filter import GyroscopeFilter
from rs_localizer.inertial.gyroscope_noise import InertialSettings
from rs_localizer.inertial.offset_search import BY_TURNS, OffsetSearch, Orientation
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.status import InertialStatus, Unused
from rs_localizer.inertial.turning import turn_between

# So many of the last frames that contradict the gyroscope are no chance.
_WATCHED, _CONTRADICTIONS = 12, 6
# Turns of the camera that are kept to see if they agree, and how often that is tried (frames).
_KEPT, _TRY_EVERY = 90, 15
_LONGEST_PAIR_NS = 200_000_000
_MEMORY_NS = 4_000_000_000
# Turns smaller than this, in deviations, say nothing.
_TELLING = 5.0
# Of the camera's turns and the gyroscope's, as a part of them, beyond the deviations.
_ALLOWED = 0.03


class GyroscopeWatch:
    """Drops a gyroscope that contradicts the camera, and takes it up again."""

    def __init__(self, settings: InertialSettings, filter_: GyroscopeFilter) -> None:
        self._settings, self._filter = settings, filter_
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.dropped: Unused | None = None
        self._contradictions: deque[bool] = deque(maxlen=_WATCHED)
        # From one time (ns) to another, of the camera as a rotation vector.
        self._turns: deque[tuple[int, int, Array]] = deque(maxlen=_KEPT)
        self._last: Orientation | None = None
        self._search = OffsetSearch(step=BY_TURNS)
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

    def judge(self, contradicts: bool, frame: Orientation | None) -> None:
        """Take in a frame.

        Args:
            contradicts: the gyroscope.
            frame: its pose, if it was found without the gyroscope.
        """
        self._contradictions.append(contradicts)
        if frame is not None:
            self._follow(frame)
        if self.dropped is None:
            if sum(self._contradictions) >= _CONTRADICTIONS:
                self.dropped, self._untried = Unused(ImuReason.DISAGREES), 0
                self._search = OffsetSearch(step=BY_TURNS)
                self._filter.reset()  # what it learned of such a gyroscope is nothing
            return
        if frame is not None and self._settings.estimate_time_offset:
            self._search.add(frame)
            found = self._search.look(*self.heard)
            if found is not None:
                self._filter.reset(found.time_offset, 2.0 * found.deviation)
                self.take_up()
                return
        self._untried += 1
        if self._untried >= _TRY_EVERY:
            self._untried = 0
            self._compare()

    def _follow(self, frame: Orientation) -> None:
        last, self._last = self._last, frame
        if last is None or not 0 < frame.middle_ns - last.middle_ns <= _LONGEST_PAIR_NS:
            return
        turn = so3.log(np.ascontiguousarray(last.rotation @ frame.rotation.T))
        if np.linalg.norm(turn) > _TELLING * math.hypot(frame.deviation, last.deviation):
            self._turns.append((last.middle_ns, frame.middle_ns, turn))

    def _compare(self) -> None:
        """Take it up where the two agree."""
        if not self._samples:
            return
        samples, errors = ImuSamples(*self.heard), self._filter.errors
        pairs = [
            (so3.log(between.rotation.T.copy()), turn)
            for from_ns, to_ns, turn in self._turns
            if (between := turn_between(samples, from_ns, to_ns, errors)) is not None
        ]
        shown, seen = np.array(pairs).reshape(-1, 2, 3).transpose(1, 0, 2)
        if len(seen) and np.sum((seen - shown) ** 2) < _ALLOWED * np.sum(seen**2):
            self.take_up()

    def take_up(self) -> None:
        """Believe it again."""
        self.dropped = None
        self._contradictions.clear()

    def status(self, unused: Unused | None) -> InertialStatus:
        """State of the gyroscope, for who tells of it."""
        errors = self._filter.errors
        *biases, offset = errors.covariance.diagonal().tolist()
        return InertialStatus(
            unused,
            errors.bias,
            math.sqrt(sum(biases) / len(biases)),
            errors.time_offset,
            math.sqrt(offset),
        )
