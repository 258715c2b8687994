# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Oddities that stamps and poses of successive frames show, and no single frame does."""

from collections import deque
from collections.abc import Callable

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.core.types import Estimate
from rs_localizer.pipeline.refusal import Notify, Refusal

# Frames that come in another order than they were taken are late by less (s); a recording that
# starts over goes back by more.
_LATE = 0.5
# A camera that is so many times faster than configured, over so many s, measures in other units:
# of a map in millimetres poses are a thousand times too far apart, and as much less certain.
_TOO_FAST, _WINDOW = 20.0, 2.0
_LONGEST_STEP = 0.5  # s


class Stream:
    """The order of the frames, and whether their poses can be those of a camera.

    Args:
        notice: told what is odd.
        forget: called where a frame cannot follow the last one.
    """

    def __init__(self, notice: Notify, forget: Callable[[], None]) -> None:
        self._notice, self._forget = notice, forget
        self.reset()

    def reset(self) -> None:
        """The next frame is the first."""
        self._last: tuple[int, str] | None = None  # stamp and map frame of the frame before
        self._places: deque[tuple[int, Array, float]] = deque()  # ns, m, m^2

    def follow(self, stamp_ns: int, frame: str) -> Refusal | None:
        """Start afresh where a frame cannot follow the last one; a refusal of one out of order.

        Args:
            stamp_ns: of the image; 0 says nothing of its time.
            frame: of the points.
        """
        last_ns, last_frame = self._last or (stamp_ns, frame)
        late = (last_ns - stamp_ns) * 1e-9
        if self._last is not None and stamp_ns and frame == last_frame and 0.0 <= late < _LATE:
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

    def pace(self, time_ns: int, estimate: Estimate, config: NodeConfig) -> None:
        """Look whether poses run faster than any camera does."""
        places = self._places
        if places and not 0.0 < 1e-9 * (time_ns - places[-1][0]) < _LONGEST_STEP:
            places.clear()
        # Noise of poses is no motion.
        places.append((time_ns, estimate.position, estimate.covariance[3:6, 3:6].trace()))
        while 1e-9 * (time_ns - places[0][0]) > _WINDOW:
            places.popleft()
        seconds = 1e-9 * (time_ns - places[0][0])
        prior = config.velocity_prior.linear
        if prior == 0.0 or seconds < 0.5 * _WINDOW:
            return
        way = float(np.linalg.norm(places[-1][1] - places[0][1]))
        speed = (way - 3.0 * float(np.sqrt(places[-1][2] + places[0][2]))) / seconds
        if speed > _TOO_FAST * prior:
            self._notice(
                Notice.MAP_SCALE,
                f"by its poses the camera moves at {speed:.0f} m/s, velocity_prior.linear is "
                f"{prior:g}: are the points of the map in metres (not millimetres)?",
            )
