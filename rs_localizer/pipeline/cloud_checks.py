# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Oddities of correspondences that a reader of clouds cannot see, and that refuse no frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.lens import centre_of, off_centre
from rs_localizer.core.reasons import Notice
from rs_localizer.core.types import Estimate
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
# So many corners of a marker that is elsewhere are never matched; others may be, by chance.
_OF_MARKER = 2
# Corners are those of a square: what is out of it by such a share is rounding, or no marker.
_FLAT, _ROUND = 0.01, np.array([1.0, -1.0, 1.0, -1.0])
# A marker is turned if its corners are less alike than this, the cosine of 45 deg: halfway to where
# the next corner is expected.
_ALIKE = 0.7
# A way along the line of sight, but for a deviation of a fifth: another size looks like that, if it
# is by this share of the distance at least, as which a pixel of a small marker looks.
_ALONG, _RESIZED = 1.2, 0.05


def stale_landmarks(
    cloud: Correspondences, gone: BoolArray, found: Estimate, camera: Camera,
    names: Sequence[str] = (),
) -> str:  # fmt: skip
    """Name the points that are gone from a map in a sentence; empty if there are none.

    Markers, of which four ids in a row are the corners, are also said to lie where the frame shows
    them.

    Args:
        found: of the frame.
        names: of ids; none: they are their own.
    """
    if not gone.any():
        return ""
    count, listed = _names(cloud, gone, names)
    said = f"{count} landmarks in view are often seen and never matched: {listed}"
    markers = _Markers.of(cloud, names)
    for k in np.flatnonzero(gone[markers.rows].sum(axis=1) >= _OF_MARKER).tolist():
        said += f"; {markers.names[k]} {_elsewhere(k, markers, cloud, found, camera)}"
    return said


def _ids_of(cloud: Correspondences) -> IntArray | None:
    """Return the ids of a cloud's points, if it has any."""
    return cloud.table["id"].astype(np.int64) if "id" in (cloud.table.dtype.names or ()) else None


class _Markers(NamedTuple):
    """The markers of a cloud: squares of which four ids in a row are the corners."""

    rows: IntArray  # (m,4) of corners in the cloud
    centres: Array  # (m,3) as the map has them
    names: list[str]

    @classmethod
    def of(cls, cloud: Correspondences, names: Sequence[str]) -> _Markers:
        own = _ids_of(cloud)
        ids, rows = np.unique(np.zeros(0, np.int64) if own is None else own, return_index=True)
        first = np.flatnonzero((ids[:-3] % 4 == 0) & (ids[3:] == ids[:-3] + 3))
        rows = rows[first[:, None] + np.arange(4)]
        points = cloud.points[rows]
        out = np.linalg.norm(np.einsum("mki,k->mi", points, _ROUND), axis=1)
        square = out < _FLAT * np.linalg.norm(points[:, 1] - points[:, 0], axis=1)
        called = [
            names[corner] if names else f"the marker {corner} to {corner + 3}"
            for corner in ids[first[square]].tolist()
        ]
        return cls(rows[square], points[square].mean(axis=1), called)


def _elsewhere(
    marker: int, markers: _Markers, cloud: Correspondences, found: Estimate, camera: Camera
) -> str:
    """Say where a marker is of which the map has other corners.

    It is so small that its image is an affine one, of which the longest axis is not foreshortened:
    its distance is known but for its size, which the map has.
    """
    rows, centres = markers.rows[marker], markers.centres
    corners, pixels = cloud.points[rows], cloud.pixels[rows]
    rotations, translations = found.at_rows(camera.row_time(pixels))
    eye = -np.einsum("nji,nj->ni", rotations, translations).mean(axis=0)
    away = np.einsum("nji,nj->ni", rotations, camera.bearings(pixels))
    shape, axis = corners - centres[marker], away.mean(axis=0)
    seen, expected = (each / (each @ axis)[:, None] for each in (away, corners - eye))
    middle = seen.mean(axis=0)
    across, expected = seen - middle, expected - expected.mean(axis=0)
    if np.linalg.norm(across) < _FLAT * np.linalg.norm(expected):
        return "is seen as one point"
    place = eye + middle / np.linalg.norm(np.linalg.lstsq(shape, across, _FLAT)[0], 2)
    far, side = np.linalg.norm(centres - place, axis=1), np.linalg.norm(shape[0])
    way, nearest = float(far[marker]), int(np.argmin(far))
    alike = np.sum(across * expected) / (np.linalg.norm(across) * np.linalg.norm(expected))
    if way < side and alike < _ALIKE:
        return "is turned there, or its corners come in another order"
    x, y, z = place
    said = f"lies near ({x:.2f}, {y:.2f}, {z:.2f}), {way:.2g} m from there"
    if nearest != marker and far[nearest] < side:
        return f"{said}, where the map has {markers.names[nearest]}"
    seen_at, mapped = (float(np.linalg.norm(each - eye)) for each in (place, centres[marker]))
    if way < _ALONG * abs(seen_at - mapped) and abs(seen_at - mapped) > _RESIZED * mapped:
        said += f", or measures {mapped / seen_at:.2g} times what the map says"
    return said


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
    rows, ids = np.flatnonzero(some), _ids_of(cloud)
    if ids is None:
        points = np.unique(cloud.points[rows], axis=0)
        own = [f"({x:.2f}, {y:.2f}, {z:.2f})" for x, y, z in points]
    else:
        of = np.unique(ids[rows]).tolist()
        own = list(dict.fromkeys(names[each] if names else str(each) for each in of))
    return len(own), ", ".join(own[:_NAMED]) + (" ..." if len(own) > _NAMED else "")
