# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The time offset of a gyroscope from nothing: all offsets are kept until one is left.

A vibration tells the offset within a frame to a tenth of a millisecond, but for whole periods of
it. Which of them it is, the slow part of the motion tells: at the right offset the gyroscope
carries the orientations of all frames into one another. Neither is a line beyond some milliseconds,
so that a filter may lock on to a wrong period. Here each offset of a grid is supposed in turn, and
its cost, twice the negative logarithm of the likelihood, summed over the frames:

* of the rows, what the motion that is best beside the turn of this offset leaves of the errors, as
  in :mod:`rs_localizer.estimation.result`;
* of the orientations ``R``, what a first orientation, a bias and the scales of the gyroscope leave
  of ``log(G^T R)``, with the turn ``G`` since the first frame (linear least squares; the normal
  matrix is the same for all offsets).

The search ends when no other mode is left. What follows is the filter's.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.rate_spline import multiplied, rotations_at_knots, spline, turns_at
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.state import PARAMETERS
from rs_localizer.inertial.row_offset_likelihood import RowOffsetLikelihood
from rs_localizer.inertial.settings import BIAS_DEVIATION, OFFSET_DEVIATION, SCALE_DEVIATION

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
    """Costs of all offsets, from frame to frame.

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
