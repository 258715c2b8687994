# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a map of markers can be true, against what images show of them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.markers.consistency import PARALLEL, SAME_PLANE
from rs_localizer.markers.detection import Detections, IntArray
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Marker

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
    "the map contradicts the image: {} are misplaced; a position, a size or an id is wrong"
)


class MapCheck:
    """Compares what images show of single markers with how the map says they lie.

    No camera calibration is needed: what is looked for is larger than what lens and shutter do.
    """

    def __init__(self, marker_map: MarkerMap) -> None:
        self._names = [marker.name for marker in marker_map.markers]
        self._planes = _planes(marker_map.markers)
        self._rotations = [marker.pose.rotation for marker in marker_map.markers]

    def fault(self, detections: Detections) -> str | None:
        """What is wrong with the map according to this image; None if nothing can be said."""
        whole = whole_markers(detections, 4 * len(self._names))
        for plane in sorted({self._planes[m] for m in whole}):
            flat = {m: rows for m, rows in whole.items() if self._planes[m] == plane}
            for some in _neighbourhoods(detections, flat):
                text = self._flat(detections, some)
                if text is not None:
                    return text
        return self._solid(detections, self._meeting(detections, whole))

    def _flat(self, detections: Detections, whole: dict[int, IntArray]) -> str | None:
        """Markers that the map puts into one plane."""
        if len(whole) < 2:
            return None
        rows = np.concatenate(list(whole.values()))
        first = next(iter(whole))
        plane = self._rotations[first][:, :2]
        points = (detections.points[rows] - detections.points[rows[0]]) @ plane
        pixels = detections.pixels[rows]
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

    def _meeting(self, detections: Detections, whole: dict[int, IntArray]) -> dict[int, IntArray]:
        """The markers around where two of different planes are nearest to each other."""
        markers, apart = _apart(detections, whole)
        planes = np.array([self._planes[m] for m in markers])
        other = np.where(planes[:, None] == planes, np.inf, apart)
        if not np.isfinite(other).any():
            return {}
        pair = np.unravel_index(np.argmin(other), other.shape)
        nearest = apart[list(pair)].min(axis=0)
        chosen = np.argsort(nearest, kind="stable")[:_AROUND].tolist()
        return {markers[k]: whole[markers[k]] for k in sorted(chosen)}

    def _solid(self, detections: Detections, whole: dict[int, IntArray]) -> str | None:
        """All markers together: in a mirrored map, planes at an angle fit, each by itself."""
        rows = np.concatenate(list(whole.values())) if whole else np.empty(0, np.int64)
        if len(whole) < _ENOUGH or _thickness(detections.points[rows]) < _SOLID:
            return None
        misfit, mirrored = _projection(detections.points[rows], detections.pixels[rows])
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
            if float(normal @ other) > PARALLEL and off < SAME_PLANE * min(size, marker.size):
                numbers.append(number)
                break
        else:
            numbers.append(len(kept))
            kept.append((normal, float(normal @ pose.position), marker.size))
    return numbers


def whole_markers(detections: Detections, end: int) -> dict[int, IntArray]:
    """Rows of the detections for each single marker of which all four corners were found."""
    place = {int(id_): row for row, id_ in enumerate(detections.ids) if id_ < end}
    markers = sorted({id_ // 4 for id_ in place})
    corners = {m: [place.get(4 * m + k, -1) for k in range(4)] for m in markers}
    return {m: np.array(rows) for m, rows in corners.items() if min(rows) >= 0}


def _apart(detections: Detections, whole: dict[int, IntArray]) -> tuple[list[int], Array]:
    """The markers, and the distances (m,m) of their middles, px."""
    middles = np.array([detections.pixels[rows].mean(axis=0) for rows in whole.values()]).reshape(
        -1, 2
    )
    return list(whole), np.linalg.norm(middles[:, None] - middles, axis=2)


def _neighbourhoods(
    detections: Detections, whole: dict[int, IntArray]
) -> Iterator[dict[int, IntArray]]:
    """Each marker with those that are nearest to it in the image, each set once."""
    markers, apart = _apart(detections, whole)
    sets = set()
    for m, distances in enumerate(apart):
        limit = _FAR * _mean_side(detections.pixels[whole[markers[m]]])
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


def still_pose(points: Array, rays: Array) -> tuple[Array, Array] | None:
    """Rotation (3,3) and translation (3,) camera_from_map that fit best; None: there are none.

    Args:
        points: (n,3) m, map frame.
        rays: (n,2) undistorted bearings.
    """
    try:
        solved, rotation, translation = cv2.solvePnP(
            points, np.ascontiguousarray(rays), np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:
        return None
    if not solved:
        return None
    turn = np.asarray(cv2.Rodrigues(rotation)[0], np.float64)
    return turn, np.asarray(translation, np.float64).ravel()


def rms(errors: Array) -> float:
    """Root mean square of the lengths of errors (n,2)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


# With fewer in an image it cannot be said which one is off.
_LEAST_MARKERS = 3
# Images with the marker; fewer may be bad luck.
_LEAST_IMAGES = 5
# All images count until there are so many, then one in ten: a pose for each marker takes time.
_ALL_UNTIL, _ONE_IN = 60, 10
# px rms: what a still camera leaves at most.
_STILL = 0.5
# Without the marker the others fit to this share of what they fit to with it, and it is off by this
# multiple of how well they fit.
_BETTER, _CLEARLY = 0.6, 4.0


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A marker against the others in one image."""

    fit: float  # px rms of the others
    fit_with: float  # px rms of all
    off: float  # px, mean over its corners
    axes: Array  # (2,3) directions across the line of sight, in the map
    shift: Array  # (2,) m along them


Predict = Callable[[Array], Array]
"""Pixels (n,2) of points (n,3) of the map."""
Fit = Callable[[Camera, Array, Array], Predict | None]
"""What predicts, fitted to a camera's points (n,3) and pixels (n,2); None: nothing fits."""


def still_fit(camera: Camera, points: Array, pixels: Array) -> Predict | None:
    """The fit of a camera that does not move, or of a global shutter."""
    pose = still_pose(points, camera.rays(pixels))
    return None if pose is None else _predict(camera, pose)


def _predict(camera: Camera, pose: tuple[Array, Array]) -> Predict:
    return lambda some: camera.project(some @ pose[0].T + pose[1])


class LeaveOneOut:
    """Which marker of a map is not where the map has it: each is held against the others.

    In every image the pose of the camera is estimated from all markers but one, and that one is
    looked for where this pose puts it. A marker that was mounted a centimetre off is off in every
    image by as much, and the others fit each other well once it is left out; what a rolling shutter
    does changes from image to image and spares no marker. Where it does much, it has to be part of
    the fit.

    Args:
        marker_map: the map.
        fit: for images that a still camera does not explain.
    """

    def __init__(self, marker_map: MarkerMap, fit: Fit = still_fit) -> None:
        self._names = [marker.name for marker in marker_map.markers]
        self._fit = fit
        self._views: dict[int, list[_View]] = {}
        self._images = 0

    def add(self, camera: Camera, detections: Detections) -> None:
        """Take in what an image shows."""
        whole = whole_markers(detections, 4 * len(self._names))
        if len(whole) < _LEAST_MARKERS:
            return
        self._images += 1
        if self._images > _ALL_UNTIL and self._images % _ONE_IN:
            return
        rows = np.concatenate(list(whole.values()))
        points, pixels = detections.points, detections.pixels
        pose = still_pose(points[rows], camera.rays(pixels[rows]))
        if pose is None:
            return
        still = _predict(camera, pose)
        fit = still_fit if rms(still(points[rows]) - pixels[rows]) < _STILL else self._fit
        together = fit(camera, points[rows], pixels[rows])
        if together is None:
            return
        fit_with = rms(together(points[rows]) - pixels[rows])
        depths = points @ pose[0][2] + pose[1][2]
        for marker, own in whole.items():
            others = rows[~np.isin(rows, own)]
            alone = fit(camera, points[others], pixels[others])
            if alone is None:
                continue
            predicted = alone(points[own])
            turned = camera.rays(pixels[own]) - camera.rays(predicted)
            view = _View(
                fit=rms(alone(points[others]) - pixels[others]),
                fit_with=fit_with,
                off=float(np.linalg.norm((predicted - pixels[own]).mean(axis=0))),
                axes=pose[0][:2],
                shift=turned.mean(axis=0) * depths[own].mean(),
            )
            if np.isfinite([view.fit, view.fit_with, view.off, *view.shift]).all():
                self._views.setdefault(marker, []).append(view)

    def fault(self) -> str | None:
        """Which marker is off and by how much; None when none stands out."""
        candidates = {m: v for m, v in self._views.items() if len(v) >= _LEAST_IMAGES}
        if len(candidates) < _LEAST_MARKERS:
            return None
        gains = {m: _median(v, "fit") / _median(v, "fit_with") for m, v in candidates.items()}
        worst = min(gains, key=lambda m: gains[m])
        views = candidates[worst]
        fit, off = _median(views, "fit"), _median(views, "off")
        if not gains[worst] < _BETTER or not off > _CLEARLY * fit:
            return None
        away = _shift(views)
        x, y, z = (f"{value:+.4f}" for value in away)
        return (
            f"{self._names[worst]} is misplaced in the map: relative to the others, which fit to "
            f"{fit:.2f} px without it, it is off by {off:.1f} px, about "
            f"{100.0 * np.linalg.norm(away):.1f} cm ({x}, {y}, {z} m in the map)"
        )


def _median(views: list[_View], name: str) -> float:
    return float(np.median([getattr(view, name) for view in views]))


def _shift(views: list[_View]) -> Array:
    """Displacement (3,) m in the map; along the common line of sight of all views it is zero."""
    system = np.concatenate([view.axes for view in views])
    shifts = np.concatenate([view.shift for view in views])
    # Where all views look the same way, the depth is not seen: it is not made up either.
    return np.asarray(np.linalg.lstsq(system, shifts, rcond=0.3)[0])
