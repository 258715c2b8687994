# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Oddities that stamps of successive frames show, and no single frame does."""

from collections.abc import Callable

from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.pipeline.refusal import Notify, Refusal

# Frames that come in another order than they were taken are late by less (s); a recording that
# starts over goes back by more.
_LATE = 0.5


class Stream:
    """The order of the frames.

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
            self._forget()
            self._notice(name, f"{text}; the previous frames are forgotten")
        return None
