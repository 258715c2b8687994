# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Scale and place of a map, by markers of known places or points a known distance apart.

Both are seen in images beside the landmarks, and triangulated with the refined motion. Markers also
take part in the adjustment, where they hold frame, size and shape of the map.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.tools.mapping.gauge import Similarity, through, upright
from rs_localizer.tools.mapping.map_keypoints import MapObservations, Start
from rs_localizer.tools.mapping.structure import SeenImage
from rs_localizer.tools.mapping.triangulation import Sights, Triangulated, triangulate

# Corners of markers are where their map says to this part of their extent, or one of both is wrong.
_MOST_MISFIT = 0.02
_LEAST_CORNERS = 4
# Standard deviation (m) of corners in their map: prints are measured to within this.
_DEVIATION = 0.001


class PointSight(NamedTuple):
    """A named point in an image."""

    name: str
    view: int  # row of the views
    pixel: tuple[float, float]  # raw


@dataclass(frozen=True, slots=True, eq=False)
class Anchors:
    """Points that are seen beside the landmarks."""

    marker_map: MarkerMap | None = None
    sights: tuple[PointSight, ...] = ()
    distance: tuple[str, str, float] | None = None  # two names, and m between them

    @property
    def names(self) -> list[str]:
        return sorted({sight.name for sight in self.sights})

    @property
    def corners(self) -> int:
        """Number of the marker map's points, which come first."""
        return 0 if self.marker_map is None else len(self.marker_map.points)

    @property
    def count(self) -> int:
        return self.corners + len(self.names)

    def seen(self, views: Sequence[SeenImage]) -> tuple[IntArray, IntArray, Array]:
        """Return views (n,), anchors (n,) and pixels (n,2) of all sights."""
        names = self.names
        every = [
            (row, corner, pixel)
            for row, view in enumerate(views if self.corners else ())
            for corner, pixel in zip(view.corner_ids.tolist(), view.corners.tolist(), strict=True)
        ]
        every += [(of.view, self.corners + names.index(of.name), of.pixel) for of in self.sights]
        rows, anchors = (np.array([of[k] for of in every], np.int64) for k in (0, 1))
        return rows, anchors, np.reshape([of[2] for of in every], (-1, 2)).astype(np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Frame of a map, and what says so."""

    similarity: Similarity  # to metres
    scaled: bool
    basis: str
    up: str = "as the camera was held on average (a guess)"


def placement(
    anchors: Anchors, triangulated: Triangulated, rotations: Array, positions: Array
) -> Placement:
    """Return the frame of the map in metres.

    Args:
        anchors: known points, a distance, or markers.
        triangulated: where they are in the map.
        rotations, positions: (g,3,3), (g,3) map_from_camera of all views, as they were held.

    Raises:
        ValueError: if the anchors contradict the map or were not seen.
    """
    if anchors.marker_map is not None:
        return _by_markers(anchors.marker_map, triangulated)
    # The direction most often at right angles to image rows, as cameras are held level; its sign is
    # that of the mean downward direction of the images.
    across = rotations[:, :, 0]
    axis, down = np.linalg.eigh(across.T @ across)[1][:, 0], rotations[:, :, 1].mean(axis=0)
    turn = upright(axis if axis @ down >= 0.0 else -axis)
    if anchors.distance is None:
        return Placement(
            Similarity(1.0, turn, -turn @ positions[0]), False, "the scale is undetermined"
        )
    one, other, metres = anchors.distance
    rows = [anchors.corners + anchors.names.index(name) for name in (one, other)]
    apart = float(np.linalg.norm(np.subtract(*triangulated.points[rows])))
    if not apart > 0.0:  # NaN: one of them is seen by one image only, or far away
        raise ValueError(
            f"the distance {one} {other} gives no scale: each point must be given in two images or "
            "more that see it from different places"
        )
    scale = metres / apart
    similarity = Similarity(scale, turn, -scale * turn @ positions[0])
    return Placement(similarity, True, f"the distance {one} {other}")


def determined_corners(marker_map: MarkerMap, triangulated: Triangulated) -> BoolArray:
    """Return a mask (c,) of the map's corners that three images or more see."""
    count = len(marker_map.points)
    places, counts = triangulated.points[:count], triangulated.counts[:count]
    return np.asarray(np.isfinite(places).all(axis=1) & (counts > 2))


def _by_markers(marker_map: MarkerMap, triangulated: Triangulated) -> Placement:
    truth = marker_map.points
    places = triangulated.points[: len(truth)]
    determined = determined_corners(marker_map, triangulated)
    if np.count_nonzero(determined) < _LEAST_CORNERS:
        raise ValueError(
            f"{np.count_nonzero(determined)} corners of the marker map are seen by three images or "
            f"more, {_LEAST_CORNERS} are needed: show the markers from several places"
        )
    # A corner that was seen briefly is known worse than its print.
    spread = np.hypot(triangulated.spread[: len(truth)][determined], _DEVIATION)
    similarity = through(places[determined], truth[determined], spread)
    errors = np.linalg.norm(similarity(places[determined]) - truth[determined], axis=1)
    extent = float(np.linalg.norm(np.ptp(truth[determined], axis=0)))
    misfit = float(np.sqrt(np.average(errors**2, weights=spread**-2.0)))
    if misfit > _MOST_MISFIT * extent:
        raise ValueError(
            f"the markers do not lie where their map says: corners are off by {1e3 * misfit:.0f} "
            f"mm (rms) over {extent:.2f} m; check sizes and places in the marker map"
        )
    count, off = np.count_nonzero(determined), f"{1e3 * misfit:.1f} mm (rms)"
    basis = f"{count} corners of markers, within {off} of their map"
    return Placement(similarity, True, basis, "as in the marker map")


# Observations that determine a corner.
_LEAST_OBSERVATIONS = 3


def marker_constraints(
    camera: Camera, seen: MapObservations, start: Start, corners: MapObservations, places: Array
) -> tuple[MapObservations, Start, Array | None]:
    """Return inputs with corners of markers, in their frame; without, if too few are seen.

    With the deviations (p,) of all landmarks, m; None: without corners.

    Args:
        seen, start: of the landmarks.
        corners: of the same images; their landmarks are rows of ``places``.
        places: (c,3) m, of the corners.
    """
    at = corners.images
    rough = Sights(start.rotations[at], start.positions[at], corners.pixels, corners.landmarks)
    triangulated = triangulate(camera, rough, len(places))
    known = np.isfinite(triangulated.points).all(axis=1) & (
        triangulated.counts >= _LEAST_OBSERVATIONS
    )
    if np.count_nonzero(known) < _LEAST_CORNERS:
        return seen, start, None
    to_markers = through(triangulated.points[known], places[known])
    kept = known[corners.landmarks]
    count = len(start.points)
    images = np.concatenate([seen.images, at[kept]])
    order: IntArray = np.argsort(images, kind="stable")
    return (
        MapObservations(
            seen.stamps_ns,
            images[order],
            np.concatenate([seen.landmarks, count + corners.landmarks[kept]])[order],
            np.concatenate([seen.pixels, corners.pixels[kept]])[order],
        ),
        Start(
            np.concatenate([to_markers(start.points), places]),
            to_markers.rotation @ start.rotations,
            to_markers(start.positions),
        ),
        np.repeat([np.inf, _DEVIATION], [count, len(places)]),
    )
