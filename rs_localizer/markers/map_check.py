# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Checks of a map of markers: by itself, and by what images show of it."""

from collections.abc import Callable, Iterator

import cv2
import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.markers.detection import Detections
from rs_localizer.markers.maps import MarkerMap

# A marker this many times larger than the median has its size in another unit, and so have all of
# them if they are larger than any that is printed (m); so have squares of boards.
_OTHER_UNIT, _LARGEST, _LARGEST_SQUARE = 20.0, 5.0, 2.0


def other_units(marker_map: MarkerMap) -> Iterator[str]:
    """Yield sentences about sizes that do not seem to be in metres."""
    for board in marker_map.boards:
        if (large := board.square) > _LARGEST_SQUARE:
            yield (
                f"{board.name} with {large:g} m from corner to corner: sizes are in metres; "
                f"{1e-3 * large:g} would be {large:g} mm"
            )
    usual = float(np.median([marker.size for marker in marker_map.markers] or [0.0]))
    if usual > _LARGEST:
        yield f"markers of {usual:g} m: are sizes and positions, given in metres, in another unit?"
    for marker in marker_map.markers:
        if not usual / _OTHER_UNIT <= marker.size <= usual * _OTHER_UNIT:
            yield (
                f"{marker.name} has a size of {marker.size:g} m, where {usual:g} m is usual: "
                "is it in another unit?"
            )


def whole_markers(detections: Detections, end: int) -> dict[int, IntArray]:
    """Return the rows of detections of each single marker whose four corners were all found."""
    place = {int(id_): row for row, id_ in enumerate(detections.ids) if id_ < end}
    markers = sorted({id_ // 4 for id_ in place})
    corners = {m: [place.get(4 * m + k, -1) for k in range(4)] for m in markers}
    return {m: np.array(rows) for m, rows in corners.items() if min(rows) >= 0}


Predict = Callable[[Array], Array]
"""Pixels (n,2) of points (n,3) of the map."""
Fit = Callable[[Camera, Array, Array], Predict | None]
"""Fit to a camera's points (n,3) and pixels (n,2): what predicts; None: nothing fits."""


def still_fit(camera: Camera, points: Array, pixels: Array) -> Predict | None:
    """Return the projection by the best pose of a still camera or a global shutter."""
    rays = np.ascontiguousarray(camera.rays(pixels))
    try:
        solved, turn, shift = cv2.solvePnP(points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:
        return None
    rotation, translation = np.asarray(cv2.Rodrigues(turn)[0], np.float64), np.ravel(shift)
    return (lambda some: camera.project(some @ rotation.T + translation)) if solved else None


def still_residual(camera: Camera, points: Array, pixels: Array) -> float:
    """Return the error (px rms) of the best still pose of points (n,3) at pixels (n,2), or NaN."""
    predict = still_fit(camera, points, pixels)
    return np.nan if predict is None else _rms(predict(points) - pixels)


def _rms(errors: Array) -> float:
    """Return the root mean square of the lengths of errors (n,2)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


# With fewer in an image it cannot be said which one is off; fewer images with one may be bad luck.
_LEAST_MARKERS, _LEAST_IMAGES = 3, 5
# All images count until there are so many, then one in ten: a pose for each marker takes time.
_ALL_UNTIL, _ONE_IN = 60, 10
_STILL = 0.5  # px rms: what a still camera leaves at most
# Without the marker the others fit to this share of what they fit to with it, and it is off by this
# multiple of how well they fit.
_BETTER, _CLEARLY = 0.6, 4.0


class MapCheck:
    """Residual of each marker in a pose by the others: which is not where the map has it.

    In every image the pose is estimated from all markers but one, which is looked for where that
    pose puts it: what a rolling shutter does changes from image to image and spares no marker.

    Args:
        marker_map: the map.
        fit: for images that a still camera does not explain.
    """

    def __init__(self, marker_map: MarkerMap, fit: Fit = still_fit) -> None:
        self._markers, self._fit, self._images = marker_map.markers, fit, 0
        # By marker: px rms of the others, and of all; px and m that it is off.
        self._views: dict[int, list[tuple[float, ...]]] = {}

    def add(self, camera: Camera, detections: Detections) -> None:
        """Take in what an image shows."""
        whole = whole_markers(detections, 4 * len(self._markers))
        if len(whole) < _LEAST_MARKERS:
            return
        self._images += 1
        if self._images > _ALL_UNTIL and self._images % _ONE_IN:
            return
        rows = np.array(list(whole.values()))
        points, pixels = detections.points[rows], detections.pixels[rows]  # (m,4,3) and (m,4,2)
        every = points.reshape(-1, 3), pixels.reshape(-1, 2)
        fit = still_fit if still_residual(camera, *every) < _STILL else self._fit
        together = fit(camera, *every)
        for k, marker in enumerate(whole):
            others = np.delete(points, k, 0).reshape(-1, 3), np.delete(pixels, k, 0).reshape(-1, 2)
            alone = fit(camera, *others)
            if together is None or alone is None:
                continue
            off = float(np.linalg.norm((alone(points[k]) - pixels[k]).mean(axis=0)))
            side = np.linalg.norm(pixels[k] - np.roll(pixels[k], 1, axis=0), axis=1).max()
            view = (
                _rms(alone(others[0]) - others[1]),
                _rms(together(every[0]) - every[1]),
                off,
                off / side * self._markers[marker].size,
            )
            if np.isfinite(view).all():
                self._views.setdefault(marker, []).append(view)

    def misplaced(self) -> str | None:
        """Name of the marker that is off, and by how much; None when none stands out."""
        views = {
            marker: np.median(some, axis=0)
            for marker, some in self._views.items() if len(some) >= _LEAST_IMAGES
        }  # fmt: skip
        if len(views) < _LEAST_MARKERS:
            return None
        worst = min(views, key=lambda marker: float(views[marker][0] / views[marker][1]))
        fit, fit_with, off, metres = views[worst]
        if not fit < _BETTER * fit_with or not off > _CLEARLY * fit:
            return None
        return (
            f"{self._markers[worst].name} is misplaced in the map: relative to the others, which "
            f"fit to {fit:.2f} px without it, it is off by {off:.1f} px, {100 * metres:.1f} cm or "
            "more"
        )
