# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a map of markers can be true: by itself, and the residual of each marker in images."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import minimize_scalar

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.markers.detection import Detections, IntArray
from rs_localizer.markers.maps import MarkerMap

# A marker this many times larger than the median has its size in another unit, and so have all of
# them if they are larger than any that is printed (m).
_OTHER_UNIT, _LARGEST = 20.0, 5.0
# Squares and circles of boards are farther apart than this (m) on no print.
_LARGEST_SQUARE = 2.0


def other_units(marker_map: MarkerMap) -> Iterator[str]:
    """What speaks for sizes that are not in metres."""
    for board in marker_map.boards:
        if board.spacing > _LARGEST_SQUARE:
            yield (
                f"{board.name} with {board.spacing:g} m from corner to corner: sizes are in "
                f"metres; {1e-3 * board.spacing:g} would be {board.spacing:g} mm"
            )
    if not marker_map.markers:
        return
    usual = float(np.median([marker.size for marker in marker_map.markers]))
    if usual > _LARGEST:
        yield f"markers of {usual:g} m: are sizes and positions, given in metres, in another unit?"
    for marker in marker_map.markers:
        if not usual / _OTHER_UNIT <= marker.size <= usual * _OTHER_UNIT:
            yield (
                f"{marker.name} has a size of {marker.size:g} m, where {usual:g} m is usual: "
                "is it in another unit?"
            )


def whole_markers(detections: Detections, end: int) -> dict[int, IntArray]:
    """Rows of the detections for each single marker of which all four corners were found."""
    place = {int(id_): row for row, id_ in enumerate(detections.ids) if id_ < end}
    markers = sorted({id_ // 4 for id_ in place})
    corners = {m: [place.get(4 * m + k, -1) for k in range(4)] for m in markers}
    return {m: np.array(rows) for m, rows in corners.items() if min(rows) >= 0}


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


# Another reading leaves this share of what is told, in this share of the images.
_MUCH_BETTER, _MOSTLY = 0.4, 0.8
_TURNED = ("", "a quarter", "half", "three quarters")  # of a whole turn
_SCALES = np.exp(np.linspace(-0.8, 0.8, 17))  # 0.45 to 2.2
_LENS, _SIZE = "lens", "size"


class OtherReadings:
    """Whether all markers fit another way round, of other sizes, or by a lens of another scale.

    Args:
        marker_map: the map.
    """

    def __init__(self, marker_map: MarkerMap) -> None:
        self._markers = marker_map.markers
        self._images = 0
        self._votes: dict[str, list[float]] = {}

    def add(self, camera: Camera, detections: Detections) -> None:
        """Take in what an image shows."""
        whole = whole_markers(detections, 4 * len(self._markers))
        if len(whole) < _LEAST_MARKERS or self._images >= _ALL_UNTIL:
            return
        self._images += 1
        rows = np.array(list(whole.values()))
        points, pixels = detections.points[rows], detections.pixels[rows]
        told = _still_rms(camera, points, pixels)
        if not told > _STILL:
            return
        middles = points.mean(axis=1, keepdims=True)

        def of_size(scale: float) -> float:
            return _still_rms(camera, middles + scale * (points - middles), pixels)

        def of_lens(scale: float) -> float:
            matrix = camera.K * [[scale, 1.0, 1.0], [1.0, scale, 1.0], [1.0, 1.0, 1.0]]
            return _still_rms(replace(camera, K=matrix), points, pixels)

        def of_image(scale: float) -> float:
            matrix = camera.K * [[scale], [scale], [1.0]]
            return _still_rms(replace(camera, K=matrix), points, pixels)

        found = {
            text: (_still_rms(camera, np.roll(points, turns, axis=1), pixels), float(turns))
            for turns, text in enumerate(_TURNED) if turns
        }  # fmt: skip
        found[_SIZE], found[_LENS] = _least(of_size), min(_least(of_lens), _least(of_image))
        best = min(found, key=lambda name: found[name][0])
        if found[best][0] < _MUCH_BETTER * told:
            self._votes.setdefault(best, []).append(found[best][1])

    def fault(self) -> str | None:
        """What all of them say; None where the map is the best reading."""
        if self._images < _LEAST_MARKERS or not self._votes:
            return None
        name, scales = max(self._votes.items(), key=lambda item: len(item[1]))
        if len(scales) < _MOSTLY * self._images:
            return None
        scale, count = float(np.median(scales)), len(self._markers)
        if name == _LENS:
            return (
                f"the focal length that fits is {scale:.2f} of what is told: is K that of a binned "
                "image, or of another resolution?"
            )
        if name == _SIZE:
            why = "measured with the white rim" if scale < 1.0 else "is it the side of the pattern"
            return (
                f"each marker alone says {scale:.2f} of its size in the map: {why}? It is the side "
                "of the black square"
            )
        drawn = any("apriltag" in marker.family.kind for marker in self._markers)
        why = "OpenCV draws AprilTags so" if drawn and name == _TURNED[2] else "do they hang so?"
        return f"all {count} markers fit turned by {name}: {why}"


def _still_rms(camera: Camera, points: Array, pixels: Array) -> float:
    """What a still camera leaves (px) of markers (m,4,3) at pixels (m,4,2); inf: no pose."""
    points, pixels = points.reshape(-1, 3), pixels.reshape(-1, 2)
    predict = still_fit(camera, points, pixels)
    left = np.inf if predict is None else rms(predict(points) - pixels)
    return float(left) if np.isfinite(left) else np.inf


def _least(left: Callable[[float], float]) -> tuple[float, float]:
    """What the best scale leaves, and that scale."""
    best = int(np.argmin([left(float(scale)) for scale in _SCALES]))
    around = _SCALES[max(best - 1, 0)], _SCALES[min(best + 1, len(_SCALES) - 1)]
    fine = minimize_scalar(left, bounds=around, method="bounded", options={"xatol": 1e-3})
    return float(fine.fun), float(fine.x)


def _median(views: list[_View], name: str) -> float:
    return float(np.median([getattr(view, name) for view in views]))


def _shift(views: list[_View]) -> Array:
    """Displacement (3,) m in the map; along the common line of sight of all views it is zero."""
    system = np.concatenate([view.axes for view in views])
    shifts = np.concatenate([view.shift for view in views])
    # Where all views look the same way, the depth is not seen: it is not made up either.
    return np.asarray(np.linalg.lstsq(system, shifts, rcond=0.3)[0])
