"""Whether a frame can follow the last one."""

from __future__ import annotations

from rs_localizer.core.reasons import Notice


class Succession:
    """Remembers the stamp of the last frame and the frame of its points."""

    def __init__(self) -> None:
        self._last: tuple[int, str] | None = None

    def forget(self) -> None:
        """The next frame is the first."""
        self._last = None

    def breaks(self, stamp_ns: int, frame: str) -> dict[Notice, str]:
        """Why the next frame cannot follow, a sentence each; it is the last one now.

        Args:
            stamp_ns: of its image.
            frame: of its points.
        """
        last, self._last = self._last, (stamp_ns, frame)
        if last is None:
            return {}
        last_ns, last_frame = last
        found: dict[Notice, str] = {}
        if stamp_ns < last_ns:
            found[Notice.TIME_WENT_BACK] = (
                f"the stamp {stamp_ns * 1e-9:.3f} s lies {(last_ns - stamp_ns) * 1e-9:.3f} s "
                "before the last one; the previous frames are forgotten"
            )
        if frame != last_frame:
            found[Notice.MAP_CHANGED] = (
                f"the points are in frame {frame!r}, the last ones were in {last_frame!r}; "
                "the previous frames are forgotten"
            )
        return found
