# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Markers whose places nobody knows: in single images, and a first guess chained over images.

A square seen alone fits two poses (Collins and Bartoli, *Infinitesimal plane-based pose
estimation*, IJCV 2014). Of two markers, what image after image says of how they lie to each other
agrees for the true poses only; by what agrees most, all are chained.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.io.transforms import Transform
from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.families import LEAST_SIDE, Family
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Marker, Pose
from rs_localizer.tools.mapping.map_keypoints import middle_row_delay


@dataclass(frozen=True, slots=True, eq=False)
class Spotted:
    """The markers of one image of which all four corners were found."""

    stamp_ns: int
    markers: IntArray  # (m,) places in the list of all markers
    quads: Array  # (m,4,2) raw pixels: top left, top right, bottom right, bottom left

    def without(self, markers: Sequence[int]) -> Spotted:
        """Return the other markers."""
        others = ~np.isin(self.markers, markers)
        return Spotted(self.stamp_ns, self.markers[others], self.quads[others])


def every_marker(
    families: Sequence[Family], size: float, sizes: Mapping[int, float]
) -> tuple[Marker, ...]:
    """Return all markers of some families, all of them at the origin.

    Args:
        families: of different kinds.
        size: m, side of the black square.
        sizes: of those ids that differ.
    """
    return tuple(
        Marker.at(family.name, id_, sizes.get(id_, size), Pose())
        for family in families
        for id_ in range(family.count)
    )


class Spotter:
    """Finds markers of some families, whichever they are.

    Raises:
        MarkerMapError: for families that this OpenCV does not know.
    """

    def __init__(self, markers: Sequence[Marker]) -> None:
        self._detector = MarkerDetector(MarkerMap(tuple(markers)), LEAST_SIDE)
        self._end = 4 * len(markers)

    def spot(self, image: NDArray[np.uint8], stamp_ns: int) -> Spotted:
        """Return the markers of an image (h,w)."""
        found = self._detector.detect(image, stamp_ns)
        ids, rows = np.unique(found.ids[found.ids < self._end], return_index=True)
        counts = np.bincount(ids // 4)
        rows = rows[counts[ids // 4] == 4]  # of whole markers
        quads = found.pixels[found.ids < self._end][rows].reshape(-1, 4, 2)
        return Spotted(stamp_ns, np.flatnonzero(counts == 4), quads)


# Images of a pair that are compared, evenly chosen.
_MOST_IMAGES = 40
# Largest difference of the estimates of two images: in sides, and rad.
_SAME_PLACE, _SAME_TURN = 0.3, 0.15
# Poses of an image whose errors are within this factor of the least may be true.
_ALIKE = 3.0
# Errors of a corner beyond this (of the focal length) all count the same.
_GROSS = 0.02
# Effect of a rolling shutter on a square's pose (px).
_SHUTTER = 0.5
# Until then (s) an image is near the one before.
_NEAR = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Filmed:
    """The images of a camera."""

    camera: Camera  # its readout time: 0: a global shutter, or it is to be found
    spotted: Sequence[Spotted]  # in the order of their stamps
    stamp_offset: float = 0.0  # s from a stamp to the first row's exposure

    def times(self) -> Array:
        """Return the times (g,), s since the first stamp, of the images' middle rows."""
        start_ns = self.spotted[0].stamp_ns
        stamps = np.array([(image.stamp_ns - start_ns) * 1e-9 for image in self.spotted])
        return stamps + middle_row_delay(self.camera, self.stamp_offset)


@dataclass(frozen=True, slots=True)
class Chained:
    """Markers that hang together, and the images that show them."""

    markers: dict[int, Transform]  # origin_from_marker, by place in the list
    images: list[int]  # places of those with a pose
    poses: list[Transform]  # origin_from_camera
    apart: list[list[int]]  # markers that do not hang together with these, part by part


class _MarkerSight(NamedTuple):
    """A marker in an image."""

    marker: int
    rays: Array  # (4,2)
    poses: list[tuple[Transform, float]]  # camera_from_marker, and how far it fits, of 1


def chain(filmed: Filmed, markers: Sequence[Marker], origin: int | None) -> Chained:
    """Place the markers that hang together with one of them.

    Args:
        filmed: the images.
        markers: all there may be; only their sizes count.
        origin: place of the one whose frame is that of the others; None: the first of the most
            that hang together.
    """
    views = [_sights(filmed.camera, image, markers) for image in filmed.spotted]
    seen = sorted({sight.marker for view in views for sight in view})
    between = _between(views, markers)
    place = {marker: k for k, marker in enumerate(seen)}
    # SciPy 1.11 has no trees of other indices.
    pairs = np.array([[place[a], place[b]] for a, b in between], np.int32).reshape(-1, 2)
    costs = np.array([1.0 / support for _, support in between.values()])
    graph = csr_array((costs, (pairs[:, 0], pairs[:, 1])), shape=(len(seen),) * 2)
    tree = minimum_spanning_tree(graph)  # along the best supported chains
    count, labels = connected_components(tree, directed=False)
    parts = [[seen[m] for m in np.flatnonzero(labels == k).tolist()] for k in range(count)]
    parts.sort(key=lambda part: (-len(part), part[0]))
    first = parts[0][0] if origin is None else origin
    order, before = breadth_first_order(tree, place[first], directed=False)
    placed = {first: Transform(np.eye(3), np.zeros(3))}
    for k in order[1:].tolist():
        here, there = seen[k], seen[int(before[k])]
        step = between[min(here, there), max(here, there)][0]
        placed[here] = placed[there] @ (step if there < here else step.inverse())
    images, poses = _image_poses(views, filmed.times(), placed, markers)
    return Chained(placed, images, poses, [part for part in parts if first not in part])


def _sights(camera: Camera, image: Spotted, markers: Sequence[Marker]) -> list[_MarkerSight]:
    """Return the markers of an image with the poses camera_from_marker that fit."""
    sights, doubt = [], _SHUTTER / camera.focal_length
    for marker, quad in zip(image.markers.tolist(), image.quads, strict=True):
        rays, corners = np.ascontiguousarray(camera.rays(quad)), markers[marker].corners
        if not np.isfinite(rays).all():
            continue
        try:
            _, turns, places, errors = cv2.solvePnPGeneric(
                corners, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
            )
        except cv2.error:
            continue
        rotations = Rotation.from_rotvec(np.reshape(turns, (-1, 3))).as_matrix()
        centres = np.reshape(places, (-1, 3)).astype(np.float64)
        fits = np.exp(-(np.ravel(errors) - np.min(errors)) / doubt).tolist()
        poses = [
            (Transform(rotation, centre), fit)
            for rotation, centre, fit in zip(rotations, centres, fits, strict=True)
            if centre[2] > 0.0
        ]
        if poses:
            sights.append(_MarkerSight(marker, rays, poses))
    return sights


def _between(
    views: list[list[_MarkerSight]], markers: Sequence[Marker]
) -> dict[tuple[int, int], tuple[Transform, float]]:
    """Return transforms a_from_b of each pair a < b, and the number of images that support them."""
    images = defaultdict[tuple[int, int], list[tuple[_MarkerSight, _MarkerSight]]](list)
    for view in views:
        for one, other in combinations(sorted(view, key=lambda sight: sight.marker), 2):
            if one.marker != other.marker:
                images[one.marker, other.marker].append((one, other))
    between = {}
    for (a, b), among in images.items():
        said = [
            (k, first.inverse() @ second, fit * other)
            for k, (one, two) in enumerate(among[:: -(-len(among) // _MOST_IMAGES)])
            for first, fit in one.poses
            for second, other in two.poses
        ]
        between[a, b] = _agreed(said, max(markers[a].size, markers[b].size))
    return between


def _agreed(said: list[tuple[int, Transform, float]], size: float) -> tuple[Transform, float]:
    """Return the transform that most images support, and by how many."""
    image = np.array([k for k, _, _ in said])
    turns = np.array([of.rotation for _, of, _ in said])
    places = np.array([of.translation for _, of, _ in said])
    fits = np.array([fit for _, _, fit in said])
    cosines = 0.5 * (np.einsum("nij,mij->nm", turns, turns) - 1.0)
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    # Places that are far from both are known less well.
    reach = _SAME_PLACE * size + 0.1 * np.linalg.norm(places, axis=1)
    apart = np.linalg.norm(places[:, None] - places, axis=2) / reach[:, None]
    agree = np.exp(-((angles / _SAME_TURN) ** 2) - apart**2) * fits
    # Of each image only the candidate that agrees best counts.
    firsts = np.flatnonzero(np.diff(image, prepend=-1))
    per_image = np.maximum.reduceat(agree, firsts, axis=1)
    support = per_image.sum(axis=1)
    best = int(np.argmax(support))
    # The mean of what agrees with it, of each image one.
    weights = agree[best] * (agree[best] == per_image[best][np.searchsorted(image[firsts], image)])
    turn = Rotation.from_matrix(turns).mean(weights).as_matrix()
    return Transform(turn, weights @ places / weights.sum()), float(support[best])


def _image_poses(
    views: list[list[_MarkerSight]], times: Array, placed: dict[int, Transform],
    markers: Sequence[Marker],
) -> tuple[list[int], list[Transform]]:  # fmt: skip
    """Return images with a pose, and origin_from_camera of each."""
    images: list[int] = []
    poses: list[Transform] = []
    for k, view in enumerate(views):
        own = [(sight, placed[sight.marker]) for sight in view if sight.marker in placed]
        if not own:
            continue
        points = np.concatenate([
            markers[of.marker].corners @ place.rotation.T + place.translation for of, place in own
        ])  # fmt: skip
        rays = np.concatenate([of.rays for of, _ in own])
        options = [pose @ place.inverse() for of, place in own for pose, _ in of.poses]
        costs = np.array([_cost(option, points, rays) for option in options])
        best = options[int(np.argmin(costs))]
        if images and times[k] - times[images[-1]] < _NEAR:
            before = poses[-1].rotation
            alike = [options[m] for m in np.flatnonzero(costs <= _ALIKE * costs.min())]
            best = max(alike, key=lambda of: float(np.sum(of.rotation.T * before)))
        images.append(k)
        poses.append(best.inverse())
    return images, poses


def _cost(pose: Transform, points: Array, rays: Array) -> float:
    """Return squared errors of points (n,3) under camera_from_origin, gross ones limited."""
    local = points @ pose.rotation.T + pose.translation
    ahead = local[:, 2] > 0.0
    depth = np.where(ahead, local[:, 2], 1.0)
    squared = np.sum((local[:, :2] / depth[:, None] - rays) ** 2, axis=1)
    return float(np.sum(np.where(ahead, np.minimum(squared, _GROSS**2), _GROSS**2)))
