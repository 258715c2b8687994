"""Which marker of a map is not where the map has it: each is held against the others.

In every image the pose of the camera is estimated from all markers but one, and that one is looked
for where this pose puts it. A marker that was mounted a centimetre off is off in every image by as
much, and the others fit each other well once it is left out; what a rolling shutter does changes
from image to image and spares no marker.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rs_localizer.core.camera import Camera
from rs_localizer.core.so3 import Array
from rs_localizer.markers.detection import Detections, IntArray
from rs_localizer.markers.map_check import whole_markers
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.still import rms, still_errors, still_pose

# With fewer in an image it cannot be said which one is off.
_LEAST_MARKERS = 3
# Images with the marker; fewer may be bad luck.
_LEAST_IMAGES = 5
# All images count until there are so many, then one in ten: a pose for each marker takes time.
_ENOUGH, _ONE_IN = 100, 10
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


class LeaveOneOut:
    """Collects what images say of each single marker of a map."""

    def __init__(self, marker_map: MarkerMap) -> None:
        self._names = [marker.name for marker in marker_map.markers]
        self._views: dict[int, list[_View]] = {}
        self._images = 0

    def add(self, camera: Camera, seen: Detections) -> None:
        """Take in what an image shows."""
        whole = whole_markers(seen, 4 * len(self._names))
        if len(whole) < _LEAST_MARKERS:
            return
        self._images += 1
        if self._images > _ENOUGH and self._images % _ONE_IN:
            return
        rays = np.ascontiguousarray(camera.rays(seen.pixels))
        rows = np.concatenate(list(whole.values()))
        if not np.isfinite(rays[rows]).all():
            return

        def errors(pose: tuple[Array, Array], some: IntArray) -> Array:
            return still_errors(camera, pose, seen.points[some], seen.pixels[some])

        together = still_pose(seen.points[rows], rays[rows])
        if together is None:
            return
        fit_with = rms(errors(together, rows))
        for marker, own in whole.items():
            others = rows[~np.isin(rows, own)]
            pose = still_pose(seen.points[others], rays[others])
            if pose is None:
                continue
            local = seen.points[own] @ pose[0].T + pose[1]
            shift = (rays[own] - local[:, :2] / local[:, 2:]).mean(axis=0) * local[:, 2].mean()
            self._views.setdefault(marker, []).append(
                _View(
                    fit=rms(errors(pose, others)),
                    fit_with=fit_with,
                    off=float(np.linalg.norm(errors(pose, own).mean(axis=0))),
                    axes=pose[0][:2],
                    shift=shift,
                )
            )

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
            f"{self._names[worst]} is not where the map has it: against the others, which fit to "
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
    return np.asarray(np.linalg.lstsq(system, shifts, rcond=0.1)[0])
