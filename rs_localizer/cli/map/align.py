# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map align``: scale, direction of gravity, origin and format of a map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

from rs_localizer.cli import WORKING, refuse_existing, write_all
from rs_localizer.cli.map import info
from rs_localizer.cli.options import UsageError, argument, option
from rs_localizer.io.maps.files import SUFFIX, write_npz
from rs_localizer.markers.map_files import FORMATS, OWN, SUFFIXES, write_any

if WORKING:
    import numpy as np
    from scipy.spatial.transform import Rotation

    from rs_localizer.core.arrays import Array
    from rs_localizer.io.maps.landmarks import Map, make_map
    from rs_localizer.markers.maps import MarkerMap
    from rs_localizer.markers.poses import Pose
    from rs_localizer.markers.prints import Marker
    from rs_localizer.tools.mapping.gauge import Similarity, upright

_LEAST_FLOOR = 3  # points make a plane
# A floor whose points lie within this part of their extent of a line has no direction.
_LINE = 1e-3
_OUTPUTS = (SUFFIX, *SUFFIXES)


@dataclass(frozen=True, kw_only=True)
class Options(info.Options):
    out: Path = argument(f"ends in {', '.join(_OUTPUTS)}", "OUT")
    to: str | None = option(
        "of markers (default: .json is of wpilib, .yaml our own)", choices=list(FORMATS)
    )
    overwrite: bool = option("replace OUT", default=False)
    scale: float | None = option("factor", "FACTOR", limits=(0.0, math.inf), above=True)
    distance: tuple[float, float, float] | None = option(
        "instead: two ids (of landmarks, or of markers, whose middles count), and how far apart "
        "they are", "ID ID M",
    )  # fmt: skip
    up: tuple[float, float, float] | None = option("z of the new map, in the map as it is", "X Y Z")
    floor: list[int] = option(
        "instead: three ids or more in a level plane at the bottom of the map", "ID ...", list
    )
    origin: int | None = option("id at the origin", "ID")


def run(options: Options) -> info.Figures:
    suffix = options.out.suffix
    usual = "wpilib" if suffix == ".json" else OWN
    if suffix not in _OUTPUTS:
        raise UsageError(f"OUT must end in {' or '.join(_OUTPUTS)}, got {options.out}")
    if options.to and (suffix == SUFFIX or (options.to == "wpilib") != (usual == "wpilib")):
        raise UsageError(f"{options.to} is written to {'.json' if suffix != '.json' else '.yaml'}")
    for one, other in (("scale", "distance"), ("up", "floor")):
        if getattr(options, one) and getattr(options, other):
            raise UsageError(f"give one of --{one}, --{other}")
    refuse_existing(options)
    any_map, kind = info.read(options)
    if isinstance(any_map, Map) and suffix != SUFFIX:
        raise UsageError(f"{options.file} holds landmarks, which go to {SUFFIX}")
    wishes = (options.scale, options.distance, options.up, options.floor, options.origin)
    if any(wish not in (None, []) for wish in wishes):
        by = alignment(any_map, options)
        turn = np.degrees(Rotation.from_matrix(by.rotation).magnitude())
        shift = ", ".join(f"{value:.4f}" for value in by.translation)
        print(f"scaled by {by.scale:.6g}, turned by {turn:.3f} deg, shifted by ({shift}) m")
        any_map = moved(any_map, by)
    figures = info.describe(options.file, any_map, kind)

    def write(part: Path) -> None:
        if isinstance(any_map, Map):
            write_npz(part, any_map)
        elif suffix != SUFFIX:
            write_any(part, any_map, options.to or usual)
        else:  # corners, with ids of ``detect``: rows of its points
            ids = np.arange(len(any_map.points))
            write_npz(part, make_map(any_map.points, ids, None, any_map.map_frame))

    write_all({options.out: write})
    return {**figures, "written_to": str(options.out)}


def alignment(any_map: Map | MarkerMap, wishes: Options) -> Similarity:
    """What brings a map to where it is wanted.

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
            raise ValueError(f"the map has no {what} {number:g}")
        return np.asarray(places[int(number)])

    up = np.array(wishes.up or (0.0, 0.0, 1.0))
    if not np.linalg.norm(up) > 0.0:
        raise ValueError("the direction of up must not be 0 0 0")
    if wishes.floor:
        up = _normal(np.array([place(number) for number in wishes.floor]), any_map.points)
    turn, scale = upright(-up), wishes.scale or 1.0
    if wishes.distance is not None:
        one, other, wanted = wishes.distance
        apart = float(np.linalg.norm(place(one) - place(other)))
        if not min(apart, wanted) > 0.0:
            raise ValueError(f"--distance: {one:g} and {other:g} are {apart:g} m apart, no scale")
        scale = wanted / apart
    origin = np.zeros(3) if wishes.origin is None else place(wishes.origin)
    return Similarity(scale, turn, -scale * turn @ origin)


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


def moved(any_map: Map | MarkerMap, by: Similarity) -> Map | MarkerMap:
    """A map after a similarity, which changes the markers' sizes with the scale.

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
