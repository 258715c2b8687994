# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Maps in another frame: what is wished of it holds, and nothing else changes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Marker, Pose
from rs_localizer.tools.mapping.gauge import Similarity, upright

_LEAST_FLOOR = 3  # points make a plane
# A floor whose points lie within this part of their extent of a line has no direction.
_LINE = 1e-3


def alignment(
    any_map: Map | MarkerMap, scale: float | None = None,
    distance: tuple[float, float, float] | None = None,
    up: tuple[float, float, float] | None = None, floor: Sequence[int] = (),
    origin: int | None = None,
) -> Similarity:  # fmt: skip
    """Return the similarity that brings a map to where it is wanted.

    Args:
        scale: factor.
        distance: instead, between two ids, m.
        up: along the map's axes as they are.
        floor: instead, ids in a level plane, below the rest.
        origin: id.

    Raises:
        ValueError: for ids that the map does not have, or points that tell no direction or size.
    """
    if isinstance(any_map, MarkerMap):
        what, places = "marker", {one.id: one.pose.position for one in any_map.markers}
    else:
        ids = [] if any_map.ids is None else any_map.ids.tolist()
        what, places = "landmark", dict(zip(ids, any_map.points, strict=False))

    def place(number: float) -> Array:
        if number not in places:
            raise ValueError(f"the map has no {what} {number:.15g}")
        return np.asarray(places[int(number)])

    upward = np.array(up or (0.0, 0.0, 1.0))
    if not np.linalg.norm(upward) > 0.0:
        raise ValueError("the direction of up must not be 0 0 0")
    if floor:
        upward = _normal(np.array([place(number) for number in floor]), any_map.points)
    turn, scale = upright(-upward), scale or 1.0
    if distance is not None:
        one, other, wanted = distance
        apart = float(np.linalg.norm(place(one) - place(other)))
        if not min(apart, wanted) > 0.0:
            ids = f"{one:.15g} and {other:.15g}"
            raise ValueError(f"--distance: {ids} are {apart:g} m apart, no scale")
        scale = wanted / apart
    zero = np.zeros(3) if origin is None else place(origin)
    return Similarity(scale, turn, -scale * turn @ zero)


def _normal(floor: Array, points: Array) -> Array:
    """Return the normal of a floor (n,3), towards the side of all other points (p,3)."""
    if len(floor) < _LEAST_FLOOR:
        raise ValueError(f"a floor needs at least {_LEAST_FLOOR} ids, got {len(floor)}")
    middle = floor.mean(axis=0)
    _, extents, axes = np.linalg.svd(floor - middle)
    if not extents[1] > _LINE * extents[0]:
        raise ValueError("the ids of the floor lie on a line, which determines no level")
    normal = axes[2]
    return np.asarray(normal if (points.mean(axis=0) - middle) @ normal >= 0.0 else -normal)


def moved(any_map: Map | MarkerMap, by: Similarity) -> Map | MarkerMap:
    """Move a map by a similarity, which changes the markers' sizes with the scale.

    Raises:
        ValueError: when boards would change their size.
    """
    if isinstance(any_map, Map):
        covariances, modes = any_map.covariances, any_map.error_modes
        return replace(
            any_map,
            points=by(any_map.points),
            covariances=None if covariances is None else by.covariances(covariances),
            error_modes=None
            if modes is None
            else np.asarray(by.scale * by.rotation @ modes, np.float32),
        )
    if any_map.boards and by.scale != 1.0:
        raise ValueError("a map with boards cannot be scaled: their squares have a size")
    boards = [
        replace(one, pose=Pose(by(one.pose.position[None])[0], by.rotation @ one.pose.rotation))
        for one in any_map.boards
    ]
    markers = []
    for one in any_map.markers:
        deviations = one.deviations
        if deviations is not None:  # correlations are not kept: as if there were none
            parts = np.sqrt(deviations.reshape(2, 3) ** 2 @ by.rotation.T**2)
            deviations = (parts * [[by.scale], [1.0]]).ravel()
        markers.append(Marker(one.family, one.id, by(one.corners), deviations))
    return MarkerMap(tuple(markers), tuple(boards), any_map.map_frame)
