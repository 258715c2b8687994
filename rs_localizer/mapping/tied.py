"""Markers of known places among what is adjusted: they hold frame, size and shape of the map."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.mapping.observations import MapFreedom, MapObservations, Start
from rs_localizer.mapping.similarity import through
from rs_localizer.mapping.triangulation import Sights, triangulate

# How well corners are where their map says (m): prints are measured to within this.
_DEVIATION = 0.001
# Corners that determine a frame, and sights that determine a corner.
_LEAST_CORNERS, _LEAST_SIGHTS = 4, 3


def tied(
    camera: Camera,
    seen: MapObservations,
    start: Start,
    corners: MapObservations,
    places: Array,
) -> tuple[MapObservations, Start, MapFreedom]:
    """What is adjusted with the corners of markers, in their frame; without, if too few are seen.

    Args:
        seen, start: of the landmarks.
        corners: of the same images; their landmarks are rows of ``places``.
        places: (c,3) m, of the corners.
    """
    at = corners.images
    rough = Sights(start.rotations[at], start.positions[at], corners.pixels, corners.landmarks)
    found = triangulate(camera, rough, len(places))
    known = np.isfinite(found.points).all(axis=1) & (found.counts >= _LEAST_SIGHTS)
    if np.count_nonzero(known) < _LEAST_CORNERS:
        return seen, start, MapFreedom()
    to_markers = through(found.points[known], places[known])
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
        MapFreedom(deviations=np.repeat([np.inf, _DEVIATION], [count, len(places)])),
    )
