# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Oddities that stamps and poses of successive frames show, and no single frame does."""

import math
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.pipeline.refusal import Notify, Refusal

# Frames that come in another order than they were taken are late by less (s); a recording that
# starts over goes back by more.
_LATE = 0.5
# Hands, cars and drones accelerate at most ten times as fast as configured; by a map in centimetres
# or millimetres a hundred or a thousand times, and such a map has nothing nearer than this.
_FASTER, _NEAR = 33.0, 30.0
# Over slow ways only speeds show it; in s, times of which poses are compared, and between them.
_TOO_FAST, _WINDOW, _LONGEST_STEP, _APART = 20.0, 2.0, 0.5, 0.09
_STEP, _ROUNDING = 0.2, 1e-6  # s from pose to pose: noise of some 10 mm is 0.4 m/s^2
_ENOUGH = 3  # accelerations of which the median counts
# How fast hands are (m/s), and how far what they look at (m); the geometric mean of 100 and 1000.
_SPEED, _DEPTH, _BETWEEN = 0.5, 3.0, 316.0


class Stream:
    """The order of the frames, and a check that their poses can be a camera's.

    Args:
        notice: called with oddities.
        forget: called where a frame cannot follow the last one.
    """

    def __init__(self, notice: Notify, forget: Callable[[], None]) -> None:
        self._notice, self._forget = notice, forget
        self.zero_is_time = False  # a recording's clock starts at 0: elsewhere nobody set a stamp
        self.reset()

    def reset(self) -> None:
        """Forget all frames: the next one is the first."""
        self._last: tuple[int, str] | None = None  # stamp and map frame of the frame before
        self._places: deque[tuple[int, Array, float]] = deque()  # ns, m, m^2
        self._scale: str | None = ""  # what is wrong with that of the map; None: not known yet

    def unset(self, stamp_ns: int) -> Refusal | None:
        """Refuse an image whose sender gives no time."""
        if stamp_ns or self.zero_is_time:
            return None
        return Refusal(Reason.NO_STAMP, "header.stamp is 0: its sender does not set it")

    def follow(self, stamp_ns: int, frame: str) -> Refusal | None:
        """Start afresh where a frame cannot follow the last one; a refusal of one out of order.

        Args:
            stamp_ns: of the image.
            frame: of the points.
        """
        if (refusal := self.unset(stamp_ns)) is not None:
            return refusal
        last_ns, last_frame = self._last or (stamp_ns, frame)
        late = (last_ns - stamp_ns) * 1e-9
        before = f"the stamp {stamp_ns * 1e-9:.3f} s lies {late:.3f} s before the last one"
        if self._last is not None and frame == last_frame and 0.0 <= late < _LATE:
            if late == 0.0:
                text = f"a frame with the stamp {stamp_ns * 1e-9:.6f} s has come already"
                return Refusal(Reason.REPEATED_STAMP, text)
            return Refusal(Reason.LATE_FRAME, before)
        self._last = stamp_ns, frame
        notices: dict[Notice, str] = {}
        if late > 0.0:
            notices[Notice.TIME_WENT_BACK] = before
        if frame != last_frame:
            notices[Notice.MAP_CHANGED] = (
                f"the points are in frame {frame!r}, the last ones were in {last_frame!r}"
            )
        for name, text in notices.items():
            self._places.clear()
            self._scale = ""
            self._forget()
            self._notice(name, f"{text}; the previous frames are forgotten")
        return None

    def pace(
        self, time_ns: int, estimate: Estimate, points: Array, config: NodeConfig,
        alone: Callable[[], Estimate | Failure],
    ) -> bool:  # fmt: skip
        """Look whether poses move as no camera does; return whether the map's scale may be wrong.

        Args:
            time_ns: of the frame.
            estimate: its pose.
            points: (n,3) of the frame.
            config: settings.
            alone: localizes the frame without what is known of motion, which holds a camera back.
        """
        places = self._places
        if places and not 0.0 <= 1e-9 * (time_ns - places[-1][0]) < _LONGEST_STEP:
            places.clear()
            self._scale = ""
        depth = 0.0
        if not places or 1e-9 * (time_ns - places[-1][0]) > _APART:
            ahead = (points[estimate.inliers] - estimate.position) @ estimate.rotation[2]
            depth = float(np.median(ahead)) if len(ahead) else 0.0
        if depth > _NEAR and (found := alone()):
            places.append((time_ns, found.position, found.covariance[3:6, 3:6].trace()))
            while 1e-9 * (time_ns - places[0][0]) > _WINDOW:
                places.popleft()
            self._scale = _odd_scale(places, depth, config)
        if self._scale:
            self._notice(Notice.MAP_SCALE, self._scale)
        return self._scale != ""


def _odd_scale(
    places: Sequence[tuple[int, Array, float]], depth: float, config: NodeConfig
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
