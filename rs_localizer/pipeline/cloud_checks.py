# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Oddities of correspondences that a reader of clouds cannot see, and that refuse no frame."""

from collections.abc import Sequence

import numpy as np

from rs_localizer.core.arrays import BoolArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.lens import centre_of, off_centre
from rs_localizer.core.reasons import Notice
from rs_localizer.estimation.moved_part import MovedPart
from rs_localizer.io.clouds import Correspondences

# Coordinates in single precision shall tell millimetres, in m: they do as far as 8 km.
_FINE = 0.00097
# Trackers of features may find a point somewhat outside, in px.
_SLACK = 1.0


def oddities(
    cloud: Correspondences, camera: Camera, camera_frame: str, most: int
) -> dict[Notice, str]:
    """Return sentences on what is odd about a cloud, by notice.

    Args:
        cloud: of one image.
        camera: that ``camera_info`` describes.
        camera_frame: its optical frame.
        most: points that are used.
    """
    notices: dict[Notice, str] = {}
    if (count := len(cloud.points)) > most:
        notices[Notice.TOO_MANY_POINTS] = (
            f"{count} points have come; max_points of them, {most}, are used"
        )
    if cloud.frame == camera_frame:
        notices[Notice.MAP_IS_CAMERA] = (
            f"the points are given in {cloud.frame!r}, which is the camera's own frame: "
            "header.frame_id of the cloud (or map) must name the frame of x, y, z"
        )
    if len(cloud.points) > 0 and cloud.table.dtype["x"].itemsize <= 4:
        largest = np.abs(cloud.points).max()
        step = float(np.spacing(np.float32(largest)))
        if step >= _FINE:
            notices[Notice.COARSE_COORDINATES] = (
                f"coordinates of {largest:.0f} m in FLOAT32 are known to {1e3 * step:.0f} mm "
                "only: send them as FLOAT64, or from an origin nearby"
            )
    if off_centre(camera):
        x, y = centre_of(camera)
        notices[Notice.LENS] = (
            f"the principal point of camera_info, ({x:.0f}, {y:.0f}), is not near the middle of "
            f"{camera.size[0]} x {camera.size[1]}: is K that of another resolution, or of a whole "
            "image of which these are a region (fill in its roi)?"
        )
    width, height = camera.size
    limit = np.array(camera.size) - 0.5 + _SLACK
    outside = np.any((cloud.pixels < -0.5 - _SLACK) | (cloud.pixels > limit), axis=1)
    if np.any(outside):
        u, v = cloud.pixels[outside][0]
        notices[Notice.PIXELS_OUTSIDE] = (
            f"{outside.sum()} of {len(outside)} pixels lie outside the {width} x {height} of "
            f"camera_info, as ({u:.0f}, {v:.0f}): are both of the same camera and resolution?"
        )
    return notices


# Most landmarks that are named.
_NAMED = 12


def stale_landmarks(cloud: Correspondences, gone: BoolArray, names: Sequence[str] = ()) -> str:
    """Name the points that are gone from a map in a sentence; empty if there are none.

    Args:
        names: of ids; none: they are their own.
    """
    if not gone.any():
        return ""
    count, listed = _names(cloud, gone, names)
    return f"{count} landmarks in view are often seen and never matched: {listed}"


def moved_landmarks(
    cloud: Correspondences, part: MovedPart | None, names: Sequence[str] = ()
) -> str:
    """Name the points of a part of the map that was moved; empty if none is in view."""
    if part is None:
        return ""
    own = {tuple(point) for point in part.points.tolist()}
    moved = np.array([tuple(point) in own for point in cloud.points.tolist()], np.bool_)
    if not moved.any():
        return ""
    count, listed = _names(cloud, moved, names)
    way = 1e3 * float(np.linalg.norm(part.way))
    return (
        f"{count} landmarks in view lie together {way:.2g} mm from where the map has them, seen "
        f"from the others, or the others do: {listed}"
    )


def _names(cloud: Correspondences, some: BoolArray, names: Sequence[str]) -> tuple[int, str]:
    """Return how many landmarks some points are, and the first of their names."""
    rows = np.flatnonzero(some)
    if "id" not in (cloud.table.dtype.names or ()):
        points = np.unique(cloud.points[rows], axis=0)
        own = [f"({x:.2f}, {y:.2f}, {z:.2f})" for x, y, z in points]
    else:
        of = np.unique(cloud.table["id"][rows]).tolist()
        own = list(dict.fromkeys(names[each] if names else str(each) for each in of))
    return len(own), ", ".join(own[:_NAMED]) + (" ..." if len(own) > _NAMED else "")
