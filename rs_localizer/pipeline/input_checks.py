"""What is odd about a frame, and whether it can follow the last one."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.camera import Camera
from rs_localizer.core.lens import LensError
from rs_localizer.core.reasons import Notice
from rs_localizer.io.clouds import Correspondences

# Coordinates in single precision shall tell millimetres, in m: they do as far as 8 km.
_FINE = 0.00097
# Trackers of features may find a point somewhat outside, in px.
_SLACK = 1.0


def oddities(cloud: Correspondences, camera: Camera, camera_frame: str) -> dict[Notice, str]:
    """What is odd, a sentence each.

    Args:
        cloud: of one image.
        camera: that ``camera_info`` describes.
        camera_frame: its optical frame.
    """
    found = {
        Notice.MAP_IS_CAMERA: _frame(cloud.frame, camera_frame),
        Notice.COARSE_COORDINATES: _coordinates(cloud),
        Notice.PIXELS_OUTSIDE: _pixels(cloud, camera),
    }
    return {name: text for name, text in found.items() if text}


def _frame(frame: str, camera_frame: str) -> str:
    if frame != camera_frame:
        return ""
    return (
        f"the points are given in {frame!r}, which is the camera's own frame: header.frame_id of "
        "the cloud (or map) must name the frame of x, y, z"
    )


def _coordinates(cloud: Correspondences) -> str:
    if len(cloud.points) == 0 or cloud.table.dtype["x"].itemsize > 4:
        return ""
    largest = np.abs(cloud.points).max()
    step = float(np.spacing(np.float32(largest)))
    if step < _FINE:
        return ""
    return (
        f"coordinates of {largest:.0f} m in FLOAT32 are known to {1e3 * step:.0f} mm only: send "
        "them as FLOAT64, or from an origin nearby"
    )


def _pixels(cloud: Correspondences, camera: Camera) -> str:
    width, height = camera.size
    limit = np.array(camera.size) - 0.5 + _SLACK
    outside = np.any((cloud.pixels < -0.5 - _SLACK) | (cloud.pixels > limit), axis=1)
    if not np.any(outside):
        return ""
    u, v = cloud.pixels[outside][0]
    return (
        f"{outside.sum()} of {len(outside)} pixels lie outside the {width} x {height} of "
        f"camera_info, as ({u:.0f}, {v:.0f}): are both of the same camera and resolution?"
    )


def lens_is_off(lens: LensError) -> str:
    """What to say of a calibration that lacks distortion."""
    return (
        f"residuals vary smoothly over the image (up to {lens.pixels:.1f} px): recalibrate the "
        "lens; until then poses allow for it"
    )


class StreamResets:
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
