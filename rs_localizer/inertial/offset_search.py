# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The time offset of a gyroscope from nothing: all offsets are kept until one is left.

A vibration tells the offset within a frame to a tenth of a millisecond, but for whole periods of
it. Which of them it is, the slow part of the motion tells: at the right offset, and less its bias,
the gyroscope turned as the camera did from frame to frame. Neither is linear beyond some
milliseconds, so that a filter may lock on to a wrong period. Here each offset of a grid is supposed
in turn, and its cost, twice the negative log-likelihood, summed over the frames:

* of the rows, what the motion that is best beside the turn of this offset leaves of the errors, as
  in :mod:`rs_localizer.estimation.result`;
* of the turns, what the best bias leaves of ``log(G^T R)``, with the turns ``G`` of the gyroscope
  and ``R`` of the camera over a third of a second (linear least squares; the normal matrix is the
  same for all offsets).

The search ends when no other mode is left. What follows is the filter's.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, Array3, IntArray, Out
from rs_localizer.core.rate_spline import multiplied, rotations_at_knots, spline, turns_at
from rs_localizer.core.state import PARAMETERS
from rs_localizer.inertial.gyroscope_noise import BIAS_DEVIATION, OFFSET_DEVIATION, SCALE_DEVIATION
from rs_localizer.inertial.row_offset_likelihood import RowOffsetLikelihood
from rs_localizer.native import entry

_EACH = 60  # offsets on either side of the middle one
# s from one to the next: of frames whose rows count (a vibration of 120 Hz has 16 steps in a
# cycle), and of those of which no more than their orientation is known.
BY_ROWS, BY_TURNS = 5e-4, 1e-3
# Offsets farther than this from the best one (s) are another mode; it is no longer possible when it
# costs so much more (odds of a million to one).
_OTHER, _CLEARLY = 3e-3, 28.0
_FEWEST = 6  # frames
# Squared errors per degree of freedom of turns that agree, and as a part of the turns.
_AGREE, _EXPLAINED = 4.0, 0.1
# Samples on both sides, s; frames farther apart than this are not connected by their turn, and
# these far apart are compared: the turn of a hand changes as much as it ever does.
_AROUND_NS, _LONGEST_NS, _APART_NS = 10_000_000, 500_000_000, 300_000_000
# A frame says nothing where the gyroscope's rates differ by less than this, rad/s.
_LEAST_SWING = 0.03
# After so many frames without a decision only some are looked at: nothing new is to be seen.
_PATIENCE, _LATER = 60, 10
# Vibrations of 61 and 120 Hz were told apart from their neighbours after 10 to 14 frames.
_YOUNG = 16
# What orientations are off by beside their noise, rad: the model, and what neighbours share.
_LEAST_DEVIATION = 5e-4
# Costs of a frame are worth this part: errors of neighbouring frames are alike.
_WORTH = 0.5
_LEAST_VARIANCE = 0.05  # of errors, as a part of what the estimate left


@dataclass(frozen=True, slots=True, eq=False)
class Orientation:
    """The camera's orientation in a frame."""

    middle_ns: int
    rotation: Array  # (3,3) camera_from_map at the middle row
    deviation: float  # rad, of its axes


@dataclass(frozen=True, slots=True)
class FoundOffset:
    """The one offset that is left."""

    time_offset: float  # s, to be added to the times of the samples
    deviation: float  # s


class OffsetSearch:
    """See the module.

    Args:
        about: s, the offset in the middle of those that are tried.
        step: s, from one to the next.
    """

    def __init__(self, about: float = 0.0, step: float = BY_ROWS) -> None:
        self._about, self._step = about, step
        self._offsets: Array = step * np.arange(-_EACH, _EACH + 1, dtype=np.float64)
        self._waiting: deque[RowOffsetLikelihood | Orientation] = deque()
        # Frames, rotations (k,3,3) of all offsets, and variances (rad^2) of the last moments.
        self._last: deque[tuple[int, Array, float]] = deque()
        self._costs = (self._offsets / OFFSET_DEVIATION) ** 2 * (BY_ROWS / step) ** 2
        # Of the turns: of their squares, and by the bias.
        self._squares, self._slopes = (
            np.zeros(len(self._offsets)),
            np.zeros((len(self._offsets), 3)),
        )
        self._precision = BIAS_DEVIATION**-2
        self._rest = 0.0  # what a gyroscope that shows nothing would leave
        self._turns = self._frames = self._seen = 0

    @property
    def hopes(self) -> bool:
        """True while it has not looked at frames for long in vain."""
        return self._seen < _PATIENCE

    @property
    def is_young(self) -> bool:
        """True while it may yet find the offset of a gyroscope that is sound."""
        return self._seen < _YOUNG

    def wants(self) -> bool:
        """Count a frame; true if it is to be looked at."""
        self._seen += 1
        return self._seen < _PATIENCE or self._seen % _LATER == 0

    def add(self, sight: RowOffsetLikelihood | Orientation) -> None:
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

    def _take(
        self, sight: RowOffsetLikelihood | Orientation, times_ns: IntArray, rates: Array
    ) -> bool:
        """Take in a frame; False: its samples may yet come."""
        here_ns = sight.middle_ns - round(1e9 * self._about)
        rows = sight.rows if isinstance(sight, RowOffsetLikelihood) else np.zeros(1)
        reach = round(1e9 * (float(np.abs(rows).max()) + self._offsets[-1])) + _AROUND_NS
        if not len(times_ns) or times_ns[-1] < here_ns + reach:
            return False
        last = self._last
        if last and not 0 < sight.middle_ns - last[-1][0] <= _LONGEST_NS:
            last.clear()
        while len(last) > 1 and sight.middle_ns - last[0][0] > _APART_NS:
            last.popleft()
        apart_ns = sight.middle_ns - last[0][0] if last else 0
        first, end = np.searchsorted(times_ns, [here_ns - apart_ns - reach, here_ns + reach])
        if first == 0 or not _is_whole(times_ns[first - 1 : end + 1]):
            last.clear()
            return True
        times = np.asarray(1e-9 * (times_ns[first - 1 : end + 1] - here_ns), np.float64)
        part = np.ascontiguousarray(rates[first - 1 : end + 1])
        cubics = spline(times, part)
        turning = times, cubics, rotations_at_knots(times, cubics)
        if np.ptp(part, axis=0).max() > _LEAST_SWING:
            rotations, variance = self._of_rows(sight, turning)
            if last:
                self._compare(1e-9 * apart_ns, last[0], (rotations, variance), turning)
            last.append((sight.middle_ns, rotations, variance))
            self._frames += 1
        return True

    def _of_rows(
        self, sight: RowOffsetLikelihood | Orientation, turning: tuple[Array, Array, Array]
    ) -> tuple[Array, float]:
        """Add the costs of the rows; the rotation (k,3,3) beside each offset, and its variance."""
        if isinstance(sight, Orientation):
            same = np.broadcast_to(sight.rotation, (len(self._offsets), 3, 3))
            return same, sight.deviation**2
        costs, steps = _row_costs(
            sight.errors, sight.by_turn, sight.base, sight.to_rotation, sight.rows, sight.turned,
            *turning, self._offsets,
        )  # fmt: skip
        scale = max(float(costs.min()) / (2 * len(sight.errors) - PARAMETERS), _LEAST_VARIANCE)
        self._costs += _WORTH * costs / scale
        turned = np.tile(np.eye(3), (len(steps), 1, 1))  # by exp(-step), which is small
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            turned[:, i, j], turned[:, j, i] = steps[:, k], -steps[:, k]
        return turned @ sight.rotation, scale * sight.deviation**2

    def _compare(
        self,
        seconds: float,
        before: tuple[int, Array, float],
        now: tuple[Array, float],
        turning: tuple[Array, Array, Array],
    ) -> None:
        """Add the costs of the turn between two frames."""
        early, _ = turns_at(-self._offsets - seconds, *turning)
        late, _ = turns_at(-self._offsets, *turning)
        shown = late @ np.swapaxes(early, 1, 2)
        seen = now[0] @ np.swapaxes(before[1], 1, 2)
        off = shown @ np.swapaxes(seen, 1, 2)
        # More than the camera turned, in the axes of now: by the bias, -seconds of it.
        errors = 0.5 * np.stack(
            [off[:, 1, 2] - off[:, 2, 1], off[:, 2, 0] - off[:, 0, 2], off[:, 0, 1] - off[:, 1, 0]],
            axis=1,
        )
        cosine = 0.5 * (float(np.trace(seen[_EACH])) - 1.0)
        turned = float(np.arccos(min(max(cosine, -1.0), 1.0)))
        variance = before[2] + now[1] + 2.0 * _LEAST_DEVIATION**2 + (SCALE_DEVIATION * turned) ** 2
        weight = _WORTH / variance
        self._squares += weight * np.einsum("ki,ki->k", errors, errors)
        self._slopes += weight * seconds * errors
        self._precision += weight * seconds**2
        self._rest += weight * turned**2
        self._turns += 1

    def _decided(self) -> FoundOffset | None:
        turns = self._squares - np.einsum("ki,ki->k", self._slopes, self._slopes) / self._precision
        costs = self._costs + turns
        best = int(np.argmin(costs))
        # One that is not on this body, or turned on it, agrees nowhere.
        if turns[best] > min(_AGREE * 3.0 * _WORTH * self._turns, _EXPLAINED * self._rest):
            return None
        far = np.abs(self._offsets - self._offsets[best]) > _OTHER
        if not 0 < best < len(costs) - 1 or np.any(costs[far] < costs[best] + _CLEARLY):
            return None
        before, at, after = costs[best - 1 : best + 2]
        bend = before - 2.0 * at + after
        if not bend > 0.0:
            return None
        shift = 0.5 * self._step * (before - after) / bend
        deviation = self._step * np.sqrt(2.0 / bend)
        return FoundOffset(self._about + float(self._offsets[best] + shift), float(deviation))


def _is_whole(times_ns: IntArray) -> bool:
    steps = np.diff(times_ns)
    return len(steps) > 3 and bool(steps.max() < 2.5 * np.median(steps))


@entry
def _row_costs(
    errors: Out[Array2], by_turn: Array3, base: Array3, to_rotation: Array2, rows: Array1,
    turned: Array3,
    times: Array1, cubics: Array3, knots: Array3, offsets: Array1,
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
