"""Maps in another frame and size: scale, direction of gravity, origin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.mapping.similarity import Similarity, upright
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Marker

_LEAST_FLOOR = 3
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


def place_of(found: Map | MarkerMap) -> Place:
    """Where the landmarks, or the middles of the markers, of a map are."""
    if isinstance(found, MarkerMap):
        known = {marker.id: marker.pose.position for marker in found.markers}
    elif found.ids is None:
        known = {}
    else:
        known = dict(zip(found.ids.tolist(), found.points, strict=True))

    def place(number: int) -> Array:
        if number not in known:
            what = "marker" if isinstance(found, MarkerMap) else "landmark"
            raise ValueError(f"the map has no {what} {number}")
        return np.asarray(known[number])

    return place


def alignment(found: Map | MarkerMap, wishes: Wishes) -> Similarity:
    """What brings a map to where it is wanted.

    Raises:
        ValueError: for ids that the map does not have, or points that tell no direction or size.
    """
    place = place_of(found)
    turn = upright(-_up(found, wishes, place))
    scale = wishes.scale or 1.0
    if wishes.distance is not None:
        one, other, wanted = wishes.distance
        apart = float(np.linalg.norm(place(one) - place(other)))
        if not apart > 0.0:
            raise ValueError(f"{one} and {other} are at one place: no size can be told by them")
        scale = wanted / apart
    origin = np.zeros(3)
    if wishes.origin is not None:
        origin = place(wishes.origin)
    elif wishes.origin_at is not None:
        origin = wishes.origin_at
    return Similarity(scale, turn, -scale * turn @ origin)


def _up(found: Map | MarkerMap, wishes: Wishes, place: Place) -> Array:
    """The direction (3,) that shall point up."""
    if wishes.up is not None:
        if not np.linalg.norm(wishes.up) > 0.0:
            raise ValueError("the direction of up must not be 0 0 0")
        return wishes.up
    if wishes.upright is not None:
        if not isinstance(found, MarkerMap):
            raise ValueError("only markers stand upright; landmarks have no axes")
        place(wishes.upright)
        marker = next(marker for marker in found.markers if marker.id == wishes.upright)
        return np.asarray(marker.pose.rotation[:, 1])
    if wishes.floor:
        return _normal(np.array([place(number) for number in wishes.floor]), found.points)
    return _UP


def _normal(floor: Array, points: Array) -> Array:
    """Upward normal of a floor (n,3) that all other points (p,3) are above of."""
    if len(floor) < _LEAST_FLOOR:
        raise ValueError(f"a floor needs at least {_LEAST_FLOOR} ids, got {len(floor)}")
    middle = floor.mean(axis=0)
    _, extents, axes = np.linalg.svd(floor - middle)
    if not extents[1] > _LINE * extents[0]:
        raise ValueError("the ids of the floor lie on a line: they do not say what is level")
    normal = axes[2]
    return np.asarray(normal if (points.mean(axis=0) - middle) @ normal >= 0.0 else -normal)


def moved(found: Map, by: Similarity) -> Map:
    """A map of landmarks after a similarity."""
    covariances = found.covariances
    if covariances is not None:
        covariances = by.covariances(covariances)
    return replace(found, points=by(found.points), covariances=covariances)


def moved_markers(found: MarkerMap, by: Similarity) -> MarkerMap:
    """A marker map after a similarity, which changes the markers' sizes with the scale.

    Raises:
        ValueError: when boards would change their size.
    """
    if found.boards and by.scale != 1.0:
        raise ValueError("a map with boards cannot be scaled: their squares have a size")
    boards = tuple(
        replace(
            board,
            pose=Pose(by(board.pose.position[None])[0], by.rotation @ board.pose.rotation),
        )
        for board in found.boards
    )
    return MarkerMap(tuple(_moved(marker, by) for marker in found.markers), boards, found.map_frame)


def _moved(marker: Marker, by: Similarity) -> Marker:
    known = marker.deviations
    if known is not None:
        # Correlations are not kept: as if there were none.
        place, turn = (np.sqrt(by.rotation**2 @ part**2) for part in (known[:3], known[3:]))
        known = np.concatenate([by.scale * place, turn])
    return Marker(marker.family, marker.id, by(marker.corners), known)
