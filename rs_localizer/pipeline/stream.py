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
from rs_localizer.core.types import Estimate
from rs_localizer.pipeline.refusal import Notify, Refusal

# Frames that come in another order than they were taken are late by less (s); a recording that
# starts over goes back by more.
_LATE = 0.5
# A camera that is this many times faster than configured, over this many s, measures in other
# units: of a map in millimetres poses are a thousand times too far apart, and as much less certain.
_TOO_FAST, _WINDOW = 20.0, 2.0
_LONGEST_STEP = 0.5  # s
# s from pose to pose, of which the speed is measured: noise of some 10 mm is 0.05 m/s.
_STEP, _ROUNDING = 0.25, 1e-6


class Stream:
    """The order of the frames, and a check that their poses can be a camera's.

    Args:
        notice: called with oddities.
        forget: called where a frame cannot follow the last one.
    """

    def __init__(self, notice: Notify, forget: Callable[[], None]) -> None:
        self._notice, self._forget = notice, forget
        self.reset()

    def reset(self) -> None:
        """Forget all frames: the next one is the first."""
        self._last: tuple[int, str] | None = None  # stamp and map frame of the frame before
        self._places: deque[tuple[int, Array, float]] = deque()  # ns, m, m^2

    def unset(self, stamp_ns: int) -> Refusal | None:
        """Refuse an image whose sender gives no time."""
        if stamp_ns:
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
        if self._last is not None and frame == last_frame and 0.0 <= late < _LATE:
            if late == 0.0:
                text = f"a frame with the stamp {stamp_ns * 1e-9:.6f} s has come already"
                return Refusal(Reason.REPEATED_STAMP, text)
            text = f"the stamp {stamp_ns * 1e-9:.3f} s lies {late:.3f} s before the last one"
            return Refusal(Reason.LATE_FRAME, text)
        self._last = stamp_ns, frame
        notices: dict[Notice, str] = {}
        if late > 0.0:
            notices[Notice.TIME_WENT_BACK] = (
                f"the stamp {stamp_ns * 1e-9:.3f} s lies {late:.3f} s before the last one"
            )
        if frame != last_frame:
            notices[Notice.MAP_CHANGED] = (
                f"the points are in frame {frame!r}, the last ones were in {last_frame!r}"
            )
        for name, text in notices.items():
            self._places.clear()
            self._forget()
            self._notice(name, f"{text}; the previous frames are forgotten")
        return None

    def pace(self, time_ns: int, estimate: Estimate, points: Array, config: NodeConfig) -> None:
        """Look whether poses run faster than any camera does.

        Args:
            time_ns: of the frame.
            estimate: its pose.
            points: (n,3) of the frame.
            config: settings.
        """
        places = self._places
        if places and not 0.0 < 1e-9 * (time_ns - places[-1][0]) < _LONGEST_STEP:
            places.clear()
        places.append((time_ns, estimate.position, estimate.covariance[3:6, 3:6].trace()))
        while 1e-9 * (time_ns - places[0][0]) > _WINDOW:
            places.popleft()
        prior = config.velocity_prior.linear
        if prior == 0.0 or 1e-9 * (time_ns - places[0][0]) < 0.5 * _WINDOW:
            return
        speed = _speed(places)
        if speed > _TOO_FAST * prior:
            ahead = (points[estimate.inliers] - estimate.position) @ estimate.rotation[2]
            depth = float(np.median(ahead))
            self._notice(
                Notice.MAP_SCALE,
                f"by its poses the camera moves at {speed:.0f} m/s, {depth:.0f} m from the points, "
                f"and velocity_prior.linear is {prior:g}: is the map in millimetres? In metres, by "
                f"a factor of 0.001 (map align --scale), these are {1e-3 * speed:.2g} m/s and "
                f"{1e-3 * depth:.2g} m",
            )


def _speed(places: Sequence[tuple[int, Array, float]]) -> float:
    """Return the speed (m/s) of poses with times (ns) and variances (m^2): a median of steps.

    A hand goes to and fro: from end to end of the window it comes nowhere.
    """
    seconds = 1e-9 * np.array([time_ns - places[0][0] for time_ns, _, _ in places])
    positions = np.array([position for _, position, _ in places])
    variances = np.array([variance for _, _, variance in places])
    first = np.flatnonzero(seconds + _STEP <= seconds[-1])
    then = np.searchsorted(seconds, seconds[first] + _STEP - _ROUNDING)
    squared = np.sum((positions[then] - positions[first]) ** 2, axis=1)
    squared -= variances[then] + variances[first]  # noise of poses is no motion
    return math.sqrt(max(float(np.median(squared / (seconds[then] - seconds[first]) ** 2)), 0.0))
