# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether poses move as those of one camera in metres do: a map in another unit, two cameras."""

import math
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from rs_localizer.config import LocalizerConfig
from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import Notice
from rs_localizer.core.types import Estimate, Failure

# Hands, cars and drones accelerate at most ten times as fast as configured; by a map in centimetres
# or millimetres a hundred or a thousand times, and such a map has nothing nearer than this.
_FASTER, _NEAR = 33.0, 30.0
# Over slow ways only speeds show it; in s, times of which poses are compared, and between them.
_TOO_FAST, _WINDOW, _LONGEST_STEP, _APART = 20.0, 2.0, 0.5, 0.09
_STEP, _ROUNDING = 0.2, 1e-6  # s from pose to pose: noise of some 10 mm is 0.4 m/s^2
_ENOUGH = 3  # accelerations of which the median counts
# How fast hands are (m/s), and how far what they look at (m); the geometric mean of 100 and 1000.
_SPEED, _DEPTH, _BETWEEN = 0.5, 3.0, 316.0
# Images in a row that jump away from the last one, and back to the one before it: a camera that is
# carried elsewhere jumps once, and a wrong K on and on, but not back.
_ALTERNATING = 5


class PaceWatch:
    """Looks whether poses move as no camera does.

    Args:
        config: with typical speeds and accelerations.
    """

    def __init__(self, config: LocalizerConfig) -> None:
        self._config = config
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._places: deque[tuple[int, Array, float]] = deque()  # ns, m, m^2
        self._scale: str | None = ""  # what is wrong with that of the map; None: not known yet
        self._looked_ns, self._returned, self._apart = -math.inf, 0, ""

    @property
    def is_odd(self) -> bool:
        """Whether poses are none of a camera in metres, or nobody knows yet."""
        return self._scale != "" or self._returned >= _ALTERNATING

    @property
    def notice(self) -> Notice:
        """The name of :attr:`fault`."""
        return Notice.MAP_SCALE if self._scale else Notice.TWO_PUBLISHERS

    @property
    def fault(self) -> str:
        """How the poses contradict one camera in metres, in one sentence."""
        return self._scale or (self._apart if self._returned >= _ALTERNATING else "")

    def returns(self, away: Array | None) -> None:
        """Take a frame that jumped back to the one before the last, or None.

        ``away`` (6,) is the step from the last one, rad and m.
        """
        self._returned = 0 if away is None else self._returned + 1
        if away is None:
            return
        turn, move = math.degrees(np.linalg.norm(away[:3])), float(np.linalg.norm(away[3:]))
        self._apart = (
            f"images alternate between two places, {move:.2g} m and {turn:.2g} deg apart: are they "
            "those of two cameras? Each needs a Tracker, or both a Rig"
        )

    def add(
        self, time_ns: int, found: Estimate, points: Array, alone: Callable[[], Estimate | Failure]
    ) -> None:
        """Take a frame with a pose.

        Args:
            time_ns: of the frame.
            found: its pose.
            points: (n,3) of the frame.
            alone: returns its pose without a prior of the motion, where one holds the pose back.
        """
        places = self._places
        if places and not 0.0 <= 1e-9 * (time_ns - places[-1][0]) < _LONGEST_STEP:
            places.clear()
            self._scale = ""
        if 0.0 <= 1e-9 * (time_ns - self._looked_ns) <= _APART:
            return
        self._looked_ns = time_ns
        ahead = (points[found.inliers] - found.position) @ found.rotation[2]
        depth = float(np.median(ahead)) if len(ahead) else 0.0
        if depth > _NEAR and (free := alone()):
            places.append((time_ns, free.position, free.covariance[3:6, 3:6].trace()))
            while 1e-9 * (time_ns - places[0][0]) > _WINDOW:
                places.popleft()
            self._scale = _odd_scale(places, depth, self._config)


def _odd_scale(
    places: Sequence[tuple[int, Array, float]], depth: float, config: LocalizerConfig
) -> str | None:
    """Return in which unit a map may be whose poses are these; "": in metres; None: who knows."""
    speed, acceleration, count = _pace(places)
    most = config.velocity_prior.linear
    faster = acceleration / config.acceleration.linear
    if count < _ENOUGH:
        return None if len(places) > 1 else ""
    if faster < _FASTER and not 0.0 < _TOO_FAST * most < speed:
        return ""
    is_fine = math.sqrt(speed / _SPEED * depth / _DEPTH) > _BETWEEN
    unit, factor = ("millimetres", 1e-3) if is_fine else ("centimetres", 1e-2)
    return (
        f"by its poses the camera moves at {speed:.0f} m/s and {acceleration:.0f} m/s^2, "
        f"{depth:.0f} m from the points: is the map in {unit}? In metres, by a factor of "
        f"{factor:g} (map align --scale), these are {factor * speed:.2g} m/s, "
        f"{factor * acceleration:.2g} m/s^2 and {factor * depth:.2g} m"
    )


def _pace(places: Sequence[tuple[int, Array, float]]) -> tuple[float, float, int]:
    """Return speed (m/s), acceleration and their number, of times (ns), poses and variances (m^2).

    They are medians of steps: a hand, which goes to and fro, comes nowhere from end to end.
    """
    seconds = 1e-9 * np.array([time_ns - places[0][0] for time_ns, _, _ in places])
    positions = np.array([position for _, position, _ in places])
    variances = np.array([variance for _, _, variance in places])
    then = np.searchsorted(seconds, seconds + _STEP - _ROUNDING)
    first = np.flatnonzero(np.append(then, len(then))[then] < len(then))
    if not first.size:
        return 0.0, 0.0, 0
    then, last = then[first], then[then[first]]
    before, after = (
        (seconds[then] - seconds[first])[:, None],
        (seconds[last] - seconds[then])[:, None],
    )
    velocity = (positions[then] - positions[first]) / before
    change = 2.0 * ((positions[last] - positions[then]) / after - velocity) / (before + after)
    # Noise of poses is no motion.
    by_first, by_last = 1.0 / before[:, 0], 1.0 / after[:, 0]
    fast = np.sum(velocity**2, axis=1) - (variances[first] + variances[then]) * by_first**2
    noise = variances[first] * by_first**2 + variances[last] * by_last**2
    noise += variances[then] * (by_first + by_last) ** 2
    faster = np.sum(change**2, axis=1) - noise * (2.0 / (before + after)[:, 0]) ** 2
    speed, acceleration = (math.sqrt(max(float(np.median(x)), 0.0)) for x in (fast, faster))
    return speed, acceleration, len(first)
