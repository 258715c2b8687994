# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Gauge of a map: similarities, and covariances of a map that nothing outside of it holds.

While map and motion are adjusted the camera's positions and orientations hold them, on average,
where they were. The result is then laid over the map as it was given, by the similarity that fits
best; and the covariances are those of a map that is held so (inner constraints, free network,
Baarda's S-transform: Teunissen, *Zero order design*, in Optimization and design of geodetic
networks, 1985). Likewise surveyed markers, whose size is known: in the frame of one of them, the
errors of its own orientation grow with the distance from it; held by all corners together, what is
left is the error of the shape alone.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Marker, Pose
from rs_localizer.tools.adjust.spline import Spline
from rs_localizer.tools.adjust.variables import BODY, PLACE
from rs_localizer.tools.mapping.triangulation import Triangulated

# Points whose spread across their best line is less than this share of that along it leave the
# rotation about the line open.
_FLAT = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """``x -> scale rotation x + translation``."""

    scale: float
    rotation: Array  # (3,3)
    translation: Array  # (3,)

    def __call__(self, points: Array) -> Array:
        """Transform points (n,3) to the other frame."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    def moved(self, spline: Spline) -> Spline:
        """Transform a motion to the other frame."""
        return Spline(spline.layout, self.rotation @ spline.rotations, self(spline.positions))

    def covariances(self, before: Array) -> Array:
        """Transform covariances of points (n,3,3) to the other frame."""
        return np.asarray(self.scale**2 * self.rotation @ before @ self.rotation.T)


def scaled(factor: float) -> Similarity:
    """Return the similarity that enlarges everything about the origin."""
    return Similarity(factor, np.eye(3), np.zeros(3))


def through(points: Array, there: Array, spread: Array | None = None) -> Similarity:
    """Return the similarity from points (n,3) to places (n,3) with the least squared distances.

    S. Umeyama, Least-squares estimation of transformation parameters between two point patterns,
    PAMI 1991.

    Args:
        spread: (n,) m, how well each distance is known; None: all alike.

    Raises:
        ValueError: for fewer than three points, or points on a line.
    """
    if len(points) < 3:
        raise ValueError(f"three points or more determine a frame and its scale, got {len(points)}")
    weights = np.ones(len(points)) if spread is None else spread**-2.0
    weights = (weights / weights.sum())[:, None]
    middle, other = np.sum(weights * points, axis=0), np.sum(weights * there, axis=0)
    x, y = points - middle, there - other
    u, spreads, vt = np.linalg.svd(y.T @ (weights * x))
    if spreads[1] < _FLAT * spreads[0]:
        raise ValueError("points on one line do not determine a frame")
    signs = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = (u * signs) @ vt
    scale = float(spreads @ signs / np.sum(weights * x**2))
    return Similarity(scale, rotation, other - scale * rotation @ middle)


def upright(down: Array) -> Array:
    """Return the rotation (3,3) of a direction (3,) by the shortest way to ``-z``."""
    return np.asarray(Rotation.align_vectors([0.0, 0.0, -1.0], down)[0].as_matrix())


_ROUNDS, _OUTLIERS = 5, 4.0


def laid_over(points: Array, onto: Array, usable: BoolArray) -> tuple[Similarity, BoolArray]:
    """Return the similarity of the landmarks that hardly changed, and their mask (n,)."""
    kept = usable
    similarity = through(points[kept], onto[kept])
    for _ in range(_ROUNDS):
        off = np.linalg.norm(similarity(points) - onto, axis=1)
        kept = usable & (off <= _OUTLIERS * max(float(np.median(off[usable])), 1e-12))
        similarity = through(points[kept], onto[kept])
    return similarity, kept


def generators(points: Array, middle: Array) -> Array:
    """Return moves (n,3,7) of points by shift, rotation and size of the whole about a middle."""
    arms = points - middle
    motions = np.zeros((len(points), 3, 7))
    motions[:, :, :3] = np.eye(3)
    motions[:, :, 3:6] = -so3.hat(arms)
    motions[:, :, 6] = arms
    return motions


def as_held(covariances: Array, spread: Array, every: Array, of_kept: Array) -> Array:
    """Return covariances (n,3,3) of points if the kept ones hold the whole.

    Args:
        covariances: in another gauge.
        spread: (n,3,7) the covariance of all points times ``of_kept``.
        every: (n,3,7) the generators.
        of_kept: (n,3,7) likewise, zeros for points that do not hold the whole.
    """
    # The whole's shift, turn and size in terms of the points: inverse sum of_kept^T x.
    inverse = np.linalg.inv(np.einsum("nij,nik->jk", of_kept, of_kept))
    crossed = every @ inverse @ np.swapaxes(spread, 1, 2)
    of_whole = inverse @ np.einsum("nij,nik->jk", of_kept, spread) @ inverse
    out: Array = (
        covariances - crossed - np.swapaxes(crossed, 1, 2)
        + every @ of_whole @ np.swapaxes(every, 1, 2)
    )  # fmt: skip
    return out


def laid_on_held(points: Array, moves: Array, held: Triangulated, by: Array) -> Array:
    """Return moves (n,3,k) of points if the whole is laid back by others that hold it.

    Args:
        held: the others, which count as they are known.
        by: (m,3,k) how they move, too.
    """
    middle, weights = held.points.mean(axis=0), 1.0 / held.spread[:, None, None]
    motions = (weights * generators(held.points, middle)).reshape(-1, 7)
    of_whole = np.linalg.lstsq(motions, (weights * by).reshape(len(motions), -1), rcond=None)[0]
    return np.asarray(moves - generators(points, middle) @ of_whole)


def of_the_shape(covariance: Array, corners: Array) -> Array:
    """Return the covariance (6 m, 6 m) of positions and rotations if all corners hold it.

    Of all rigid motions that lay them over the truth, the best is the identity.

    Args:
        covariance: (6 m, 6 m) in any frame.
        corners: (m,4,3) m.
    """
    middles = corners.mean(axis=1)
    origin = middles.mean(axis=0)
    whole = np.tile(np.eye(BODY), (len(corners), 1, 1))  # how a marker moves with the whole
    whole[:, :PLACE, PLACE:] = -so3.hat(middles - origin)
    by_marker = np.zeros((len(corners), corners.shape[1], PLACE, BODY))  # and corners with it
    by_marker[..., :PLACE] = np.eye(PLACE)
    by_marker[..., PLACE:] = -so3.hat(corners - middles[:, None])
    weights = np.einsum("mcij,mcik->mjk", by_marker, by_marker)
    weighted = weights @ whole
    moved = np.linalg.inv(np.einsum("mij,mik->jk", whole, weighted))
    every, held = whole.reshape(-1, BODY), weighted.reshape(-1, BODY)
    free = np.eye(len(every)) - every @ moved @ held.T
    return np.asarray(free @ covariance @ free.T)


def alignment(
    any_map: Map | MarkerMap, scale: float | None = None,
    distance: tuple[float, float, float] | None = None,
    up: tuple[float, float, float] | None = None, origin: int | None = None,
) -> Similarity:  # fmt: skip
    """Return the similarity that brings a map to where it is wanted.

    Args:
        scale: factor.
        distance: instead, between two ids, m.
        up: along the map's axes as they are.
        origin: id.

    Raises:
        ValueError: for ids that the map does not have, or points that tell no size.
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


def moved_map(any_map: Map | MarkerMap, by: Similarity) -> Map | MarkerMap:
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
