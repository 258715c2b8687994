"""The time offset of a gyroscope from turns of the camera between frames.

Each pair of frames has a turn; at the right offset, and less its bias, the gyroscope turned as much
meanwhile. A vibration makes the error a wave of the offset, so it is searched for on a grid, and
the bias is the best at each point of it (variable projection). The curvature at the minimum tells
how well the offset is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.rate_spline import rotations_at_knots, spline, turns_at
from rs_localizer.core.so3 import log

# Offsets to try, s; finer than a tenth of the cycle of what can shake a camera at 100 Hz.
_FARTHEST, _STEP = 0.06, 0.001
# Squared errors per degree of freedom of turns that agree; covariances are a little off.
_AGREE = 4.0
_FEWEST = 12  # pairs
_LEAST_DEVIATION = 1e-5  # s


@dataclass(frozen=True, slots=True, eq=False)
class CameraTurn:
    """The turn of the camera between two frames."""

    from_ns: int
    to_ns: int
    rotation: Array  # (3,3) camera_then_from_camera_now
    deviation: float  # rad, of each axis


@dataclass(frozen=True, slots=True)
class OffsetFit:
    """The best offset."""

    time_offset: float  # s, to be added to the times of the samples
    deviation: float  # s
    misfit: float  # squared errors per degree of freedom
    at_rest: float  # the same for a gyroscope that shows nothing

    @property
    def explains(self) -> bool:
        """Whether the gyroscope agrees with the camera at this offset, and it moved enough."""
        return self.misfit < min(_AGREE, 0.1 * self.at_rest)


def fit_offset(times_ns: IntArray, rates: Array, turns: Sequence[CameraTurn]) -> OffsetFit | None:
    """The offset at which a gyroscope agrees best with the turns of a camera.

    Args:
        times_ns: (n,) of the samples.
        rates: (n,3) rad/s, camera axes.
        turns: of the camera; those that the samples do not cover at all offsets do not count.

    Returns:
        None if too few count.
    """
    reach = round(1e9 * _FARTHEST)
    covered = [
        turn
        for turn in turns
        if turn.from_ns - reach > times_ns[0] and turn.to_ns + reach < times_ns[-1]
    ]
    if len(covered) < _FEWEST:
        return None
    origin = int(times_ns[0])
    times = np.asarray(1e-9 * (times_ns - origin), np.float64)
    cubics = spline(times, np.ascontiguousarray(rates))
    knots = rotations_at_knots(times, cubics)
    start = 1e-9 * np.array([turn.from_ns - origin for turn in covered])
    end = 1e-9 * np.array([turn.to_ns - origin for turn in covered])
    seen = np.array([turn.rotation for turn in covered])
    weight = 1.0 / np.array([turn.deviation for turn in covered])

    def errors(offset: float) -> Array:
        before, _ = turns_at(start - offset, times, cubics, knots)
        after, _ = turns_at(end - offset, times, cubics, knots)
        shown = after @ np.swapaxes(before, 1, 2)
        # What the camera turned more than the gyroscope showed, in the axes of then: -dt b.
        return _logs(shown @ np.swapaxes(seen, 1, 2))

    def misfit(offset: float) -> float:
        error, along = errors(offset) * weight[:, None], -(end - start) * weight
        bias = along @ error / (along @ along)
        return float(np.sum((error - along[:, None] * bias) ** 2))

    grid = np.arange(-_FARTHEST, _FARTHEST + 0.5 * _STEP, _STEP)
    costs = np.array([misfit(offset) for offset in grid])
    best = int(np.clip(np.argmin(costs), 1, len(grid) - 2))
    step = _STEP
    offset, low, middle, high = grid[best], *costs[best - 1 : best + 2]
    for _ in range(3):  # parabolas through three points, closer and closer
        bend = low - 2.0 * middle + high
        if not bend > 0.0:
            return None
        offset += float(np.clip(0.5 * step * (low - high) / bend, -step, step))
        curvature = bend / step**2
        step *= 0.25
        low, middle, high = (misfit(offset + shift) for shift in (-step, 0.0, step))
    freedom = 3 * len(covered) - 4
    per_freedom = middle / freedom
    turned = np.einsum("n,ni->", weight**2, _logs(seen) ** 2)
    return OffsetFit(
        float(offset),
        max(math.sqrt(2.0 * max(per_freedom, 1.0) / curvature), _LEAST_DEVIATION),
        per_freedom,
        float(turned) / freedom,
    )


def _logs(rotations: Array) -> Array:
    return np.array([log(np.ascontiguousarray(rotation)) for rotation in rotations])
