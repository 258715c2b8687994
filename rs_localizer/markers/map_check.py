# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a map of markers can be true, against what an image shows of them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.markers.detection import Detections, IntArray
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Marker

# Markers within this distance of a plane (in sides) and this angle are in one.
_SAME_PLANE, _PARALLEL = 0.2, np.cos(np.radians(5.0))
# How far corners may be from where their neighbours put them, in sides of the markers. Among few
# neighbours the projection takes in what the shutter and even a fisheye lens do; a marker that is
# elsewhere, or mirrored, is off by about a side.
_FITS, _MISFITS = 0.1, 0.25
# A projection of space can be told of so many markers that fill it to this share of their extent.
_ENOUGH, _SOLID = 5, 0.1
# So many neighbours in the image are compared: of a plane, and where planes meet.
_NEIGHBOURS, _AROUND = 3, 8
# What is farther away than this (in sides) is none: there a fisheye lens counts.
_FAR = 6.0
_MISFIT_TEXT = (
    "the map does not fit the image: {} do not lie as it says; a position, a size or an id is wrong"
)


class MapCheck:
    """Compares what images show of single markers with how the map says they lie.

    No camera calibration is needed: what is looked for is larger than what lens and shutter do.
    """

    def __init__(self, marker_map: MarkerMap) -> None:
        self._names = [marker.name for marker in marker_map.markers]
        poses = [marker.pose for marker in marker_map.markers]
        self._planes = _planes(marker_map.markers)
        self._rotations = [pose.rotation for pose in poses]

    def fault(self, seen: Detections) -> str | None:
        """What is wrong with the map according to this image; None if nothing can be said."""
        whole = whole_markers(seen, 4 * len(self._names))
        for plane in sorted({self._planes[m] for m in whole}):
            flat = {m: rows for m, rows in whole.items() if self._planes[m] == plane}
            for some in _neighbourhoods(seen, flat):
                text = self._flat(seen, some)
                if text is not None:
                    return text
        return self._solid(seen, self._meeting(seen, whole))

    def _flat(self, seen: Detections, whole: dict[int, IntArray]) -> str | None:
        """Markers that the map puts into one plane."""
        if len(whole) < 2:
            return None
        rows = np.concatenate(list(whole.values()))
        first = next(iter(whole))
        points = (seen.points[rows] - seen.points[rows[0]]) @ self._rotations[first][:, :2]
        pixels = seen.pixels[rows]
        if _misfit(points, pixels) < _MISFITS:
            return None
        names = self._listed(whole)
        # A mirrored map: corners counted anticlockwise, or left and right of the room exchanged.
        swapped = points.reshape(-1, 4, 2)[:, [1, 0, 3, 2]].reshape(-1, 2)
        if _misfit(swapped, pixels) < _FITS:
            return (
                f"the map is mirrored: {names} lie in the image as in a mirror (corners go "
                "clockwise as seen from the front; frames are right-handed)"
            )
        return _MISFIT_TEXT.format(names)

    def _meeting(self, seen: Detections, whole: dict[int, IntArray]) -> dict[int, IntArray]:
        """The markers around where two of different planes are nearest to each other."""
        markers, apart = _apart(seen, whole)
        planes = np.array([self._planes[m] for m in markers])
        other = np.where(planes[:, None] == planes, np.inf, apart)
        if not np.isfinite(other).any():
            return {}
        pair = np.unravel_index(np.argmin(other), other.shape)
        nearest = apart[list(pair)].min(axis=0)
        chosen = np.argsort(nearest, kind="stable")[:_AROUND].tolist()
        return {markers[k]: whole[markers[k]] for k in sorted(chosen)}

    def _solid(self, seen: Detections, whole: dict[int, IntArray]) -> str | None:
        """All markers together: in a mirrored map, planes at an angle fit, each by itself."""
        rows = np.concatenate(list(whole.values())) if whole else np.empty(0, np.int64)
        if len(whole) < _ENOUGH or _thickness(seen.points[rows]) < _SOLID:
            return None
        misfit, mirrored = _projection(seen.points[rows], seen.pixels[rows])
        names = self._listed(whole)
        if misfit > _MISFITS:
            return _MISFIT_TEXT.format(names)
        if not mirrored or misfit > _FITS:
            return None
        return (
            f"the map is mirrored: only a left-handed room looks as {names} do in the image; "
            "frames are right-handed"
        )

    def _listed(self, whole: dict[int, IntArray]) -> str:
        more = f" and {len(whole) - 4} more" if len(whole) > 4 else ""
        return ", ".join(self._names[m] for m in list(whole)[:4]) + more


def _planes(markers: tuple[Marker, ...]) -> list[int]:
    """A number for each marker, the same for those in one plane that face the same way."""
    numbers: list[int] = []
    kept: list[tuple[Array, float, float]] = []
    for marker in markers:
        pose = marker.pose
        normal = pose.rotation[:, 2]
        for number, (other, offset, size) in enumerate(kept):
            off = abs(float(other @ pose.position) - offset)
            if float(normal @ other) > _PARALLEL and off < _SAME_PLANE * min(size, marker.size):
                numbers.append(number)
                break
        else:
            numbers.append(len(kept))
            kept.append((normal, float(normal @ pose.position), marker.size))
    return numbers


def whole_markers(seen: Detections, end: int) -> dict[int, IntArray]:
    """Rows of the detections for each single marker of which all four corners were found."""
    place = {int(id_): row for row, id_ in enumerate(seen.ids) if id_ < end}
    markers = sorted({id_ // 4 for id_ in place})
    corners = {m: [place.get(4 * m + k, -1) for k in range(4)] for m in markers}
    return {m: np.array(rows) for m, rows in corners.items() if min(rows) >= 0}


def _apart(seen: Detections, whole: dict[int, IntArray]) -> tuple[list[int], Array]:
    """The markers, and the distances (m,m) of their middles, px."""
    middles = np.array([seen.pixels[rows].mean(axis=0) for rows in whole.values()]).reshape(-1, 2)
    return list(whole), np.linalg.norm(middles[:, None] - middles, axis=2)


def _neighbourhoods(seen: Detections, whole: dict[int, IntArray]) -> Iterator[dict[int, IntArray]]:
    """Each marker with those that are nearest to it in the image, each set once."""
    markers, apart = _apart(seen, whole)
    sets = set()
    for m, distances in enumerate(apart):
        limit = _FAR * _mean_side(seen.pixels[whole[markers[m]]])
        near = np.argsort(distances, kind="stable")[:_NEIGHBOURS]
        sets.add(tuple(sorted(k for k in near.tolist() if distances[k] < limit)))
    for some in sorted(sets):
        yield {markers[k]: whole[markers[k]] for k in some}


def _normalized(values: Array) -> tuple[Array, Array]:
    """Homogeneous values (n,d+1) around 0 with deviation 1, and what makes them so."""
    dimension = values.shape[1]
    scale = np.eye(dimension + 1)
    middle, deviation = values.mean(axis=0), max(float(values.std()), 1e-12)
    scale[:dimension, :dimension] /= deviation
    scale[:dimension, dimension] = -middle / deviation
    return np.column_stack([values, np.ones(len(values))]) @ scale.T, scale


def _linear(points: Array, pixels: Array) -> Array:
    """Direct linear transform (3,d+1) from points (n,d) to pixels (n,2), both homogeneous."""
    x, points_scale = _normalized(points)
    u, pixels_scale = _normalized(pixels)
    zeros = np.zeros_like(x)
    system = np.vstack(
        [np.hstack([x, zeros, -u[:, :1] * x]), np.hstack([zeros, x, -u[:, 1:2] * x])]
    )
    solution = np.linalg.svd(system, full_matrices=False)[2][-1].reshape(3, -1)
    return np.asarray(np.linalg.solve(pixels_scale, solution @ points_scale))


def _misfit(points: Array, pixels: Array) -> float:
    """Deviation of the best homography from points (4m,2) to pixels (4m,2), in sides."""
    return _misfit_of(_linear(points, pixels), points, pixels)


def _misfit_of(camera: Array, points: Array, pixels: Array) -> float:
    mapped = np.column_stack([points, np.ones(len(points))]) @ camera.T
    if np.ptp(np.sign(mapped[:, 2])) != 0.0:
        return np.inf
    error = np.sqrt(np.mean(np.sum((mapped[:, :2] / mapped[:, 2:] - pixels) ** 2, axis=1)))
    return float(error / _mean_side(pixels))


def _thickness(points: Array) -> float:
    """Least extent of points (n,3) as a share of the largest."""
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(extents[2] / extents[0])


def _projection(points: Array, pixels: Array) -> tuple[float, bool]:
    """The best projection from points (4m,3) to pixels: its misfit, and whether it mirrors."""
    camera = _linear(points, pixels)
    if np.linalg.det(camera[:, :3]) < 0.0:
        camera = -camera
    # With a positive determinant (and v down), a camera sees what has a positive depth.
    depths = np.column_stack([points, np.ones(len(points))]) @ camera[2]
    return _misfit_of(camera, points, pixels), bool(depths.mean() < 0.0)


def _mean_side(pixels: Array) -> float:
    quads = pixels.reshape(-1, 4, 2)
    return float(np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2).mean())
