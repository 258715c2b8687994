# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map align``: scale, direction of gravity, origin and format of a map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.cli import WORKING
from rs_localizer.cli.map import either
from rs_localizer.cli.options import UsageError, option
from rs_localizer.core.arrays import Array

if WORKING:
    from scipy.spatial.transform import Rotation

    from rs_localizer.io.maps.landmarks import Map
    from rs_localizer.markers.maps import MarkerMap
    from rs_localizer.markers.poses import Pose
    from rs_localizer.markers.prints import Marker
    from rs_localizer.tools.mapping.gauge import Similarity, upright

_LEAST_FLOOR = 3  # points make a plane
# A floor whose points lie within this part of their extent of a line has no direction.
_LINE = 1e-3
_UP = np.array([0.0, 0.0, 1.0])

Place = Callable[[int], Array]
"""Where (3,) the landmark or marker of an id is, m."""


@dataclass(frozen=True, slots=True)
class Wishes:
    """What is to hold of the map; None: as it is."""

    scale: float | None = None  # factor
    distance: tuple[int, int, float] | None = None  # between two ids, m
    up: Array | None = None  # (3,) along the map's axes as they are
    floor: tuple[int, ...] = ()  # ids in a level plane, below the rest
    upright: int | None = None  # marker whose y axis points up
    origin: int | None = None  # id
    origin_at: Array | None = None  # (3,) m, in the map as it is


def place_of(any_map: Map | MarkerMap) -> Place:
    """Where the landmarks, or the middles of the markers, of a map are."""
    if isinstance(any_map, MarkerMap):
        places = {marker.id: marker.pose.position for marker in any_map.markers}
    elif any_map.ids is None:
        places = {}
    else:
        places = dict(zip(any_map.ids.tolist(), any_map.points, strict=True))

    def place(number: int) -> Array:
        if number not in places:
            what = "marker" if isinstance(any_map, MarkerMap) else "landmark"
            raise ValueError(f"the map has no {what} {number}")
        return np.asarray(places[number])

    return place


def alignment(any_map: Map | MarkerMap, wishes: Wishes) -> Similarity:
    """What brings a map to where it is wanted.

    Raises:
        ValueError: for ids that the map does not have, or points that tell no direction or size.
    """
    place = place_of(any_map)
    turn = upright(-_up(any_map, wishes, place))
    scale = wishes.scale or 1.0
    if wishes.distance is not None:
        one, other, wanted = wishes.distance
        apart = float(np.linalg.norm(place(one) - place(other)))
        if not apart > 0.0:
            raise ValueError(f"{one} and {other} are at one place: they give no scale")
        scale = wanted / apart
    origin = np.zeros(3)
    if wishes.origin is not None:
        origin = place(wishes.origin)
    elif wishes.origin_at is not None:
        origin = wishes.origin_at
    return Similarity(scale, turn, -scale * turn @ origin)


def _up(any_map: Map | MarkerMap, wishes: Wishes, place: Place) -> Array:
    """The direction (3,) that shall point up."""
    if wishes.up is not None:
        if not np.linalg.norm(wishes.up) > 0.0:
            raise ValueError("the direction of up must not be 0 0 0")
        return wishes.up
    if wishes.upright is not None:
        if not isinstance(any_map, MarkerMap):
            raise ValueError("only markers stand upright; landmarks have no axes")
        place(wishes.upright)
        marker = next(marker for marker in any_map.markers if marker.id == wishes.upright)
        return np.asarray(marker.pose.rotation[:, 1])
    if wishes.floor:
        return _normal(np.array([place(number) for number in wishes.floor]), any_map.points)
    return _UP


def _normal(floor: Array, points: Array) -> Array:
    """Upward normal of a floor (n,3) that all other points (p,3) are above of."""
    if len(floor) < _LEAST_FLOOR:
        raise ValueError(f"a floor needs at least {_LEAST_FLOOR} ids, got {len(floor)}")
    middle = floor.mean(axis=0)
    _, extents, axes = np.linalg.svd(floor - middle)
    if not extents[1] > _LINE * extents[0]:
        raise ValueError("the ids of the floor lie on a line, which determines no level")
    normal = axes[2]
    return np.asarray(normal if (points.mean(axis=0) - middle) @ normal >= 0.0 else -normal)


def moved(landmarks: Map, by: Similarity) -> Map:
    """A map of landmarks after a similarity."""
    covariances = landmarks.covariances
    if covariances is not None:
        covariances = by.covariances(covariances)
    modes = landmarks.error_modes
    if modes is not None:
        modes = np.asarray(by.scale * by.rotation @ modes, np.float32)
    return replace(
        landmarks, points=by(landmarks.points), covariances=covariances, error_modes=modes
    )


def moved_markers(marker_map: MarkerMap, by: Similarity) -> MarkerMap:
    """A marker map after a similarity, which changes the markers' sizes with the scale.

    Raises:
        ValueError: when boards would change their size.
    """
    if marker_map.boards and by.scale != 1.0:
        raise ValueError("a map with boards cannot be scaled: their squares have a size")
    boards = tuple(
        replace(
            board, pose=Pose(by(board.pose.position[None])[0], by.rotation @ board.pose.rotation)
        )
        for board in marker_map.boards
    )
    return MarkerMap(
        tuple(_moved(marker, by) for marker in marker_map.markers), boards, marker_map.map_frame
    )


def _moved(marker: Marker, by: Similarity) -> Marker:
    deviations = marker.deviations
    if deviations is not None:
        # Correlations are not kept: as if there were none.
        place, turn = (
            np.sqrt(by.rotation**2 @ part**2) for part in (deviations[:3], deviations[3:])
        )
        deviations = np.concatenate([by.scale * place, turn])
    return Marker(marker.family, marker.id, by(marker.corners), deviations)


@dataclass(frozen=True, kw_only=True)
class Options(either.OtherFileOptions):
    scale: float | None = option("factor", "FACTOR", limits=(0.0, math.inf), above=True)
    distance: tuple[str, str, str] | None = option(
        "instead: two ids (of landmarks, or of markers, whose middles count), and how far apart "
        "they are", "ID ID M",
    )  # fmt: skip
    up: tuple[float, float, float] | None = option("z of the new map, in the map as it is", "X Y Z")
    floor: list[int] = option(
        "instead: three ids or more in a level plane at the bottom of the map", "ID ...", list
    )
    upright: int | None = option("instead: an upright marker: its y axis is up", "ID")
    origin: int | None = option("id at the origin", "ID")
    origin_at: tuple[float, float, float] | None = option("instead: in the map as it is", "X Y Z")


def run(options: Options) -> either.Figures:
    either.check_output(options)
    wishes = _wishes(options)
    any_map, kind = either.read(options)
    result = any_map if wishes is None else _aligned(any_map, wishes)
    figures = either.describe(options.file, result, kind)
    either.write(options, result)
    return {**figures, "written_to": str(options.out)}


def _aligned(any_map: Map | MarkerMap, wishes: Wishes) -> Map | MarkerMap:
    """The map as it is wanted; says what that changes."""
    by = alignment(any_map, wishes)
    result = moved_markers(any_map, by) if isinstance(any_map, MarkerMap) else moved(any_map, by)
    turn = np.degrees(Rotation.from_matrix(by.rotation).magnitude())
    shift = ", ".join(f"{value:.4f}" for value in by.translation)
    print(f"scaled by {by.scale:.6g}, turned by {turn:.3f} deg, shifted by ({shift}) m")
    if isinstance(any_map, MarkerMap) and by.scale != 1.0:
        print("the sizes of the markers are scaled as well")
    return result


def _wishes(options: Options) -> Wishes | None:
    """What is to hold of the map; None: it is only to be written to another file."""
    names = ("scale", "distance", "up", "floor", "upright", "origin", "origin_at")
    if not any(getattr(options, name) not in (None, []) for name in names):
        return None
    for group in (("scale", "distance"), ("up", "floor", "upright"), ("origin", "origin_at")):
        given = [name for name in group if getattr(options, name) not in (None, [])]
        if len(given) > 1:
            raise UsageError(f"give one of {', '.join('--' + n.replace('_', '-') for n in given)}")
    distance = None
    if options.distance is not None:
        one, other, apart = options.distance
        try:
            distance = int(one), int(other), float(apart)
        except ValueError:
            raise UsageError(
                f"--distance takes two ids and metres, got {options.distance}"
            ) from None
        if not 0.0 < distance[2] < np.inf:
            raise UsageError(f"--distance: {apart} is not a length")
    return Wishes(
        options.scale, distance, _vector(options.up), tuple(options.floor), options.upright,
        options.origin,
        _vector(options.origin_at),
    )  # fmt: skip


def _vector(values: tuple[float, float, float] | None) -> Array | None:
    return None if values is None else np.array(values)
