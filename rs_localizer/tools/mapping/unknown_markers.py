# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Markers whose places nobody knows: in single images, and a first guess chained over images.

A square seen alone fits two poses (Collins and Bartoli, *Infinitesimal plane-based pose
estimation*, IJCV 2014). Of two markers, what image after image says of how they lie to each other
agrees for the true poses only; by what agrees most, all are chained.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.io.transforms import Transform
from rs_localizer.markers.detection import Detections
from rs_localizer.markers.prints import Marker
from rs_localizer.tools.mapping.map_keypoints import middle_row_delay


@dataclass(frozen=True, slots=True, eq=False)
class Spotted:
    """The markers of one image of which all four corners were found."""

    stamp_ns: int
    markers: IntArray  # (m,) places in the list of all markers
    quads: Array  # (m,4,2) raw pixels: top left, top right, bottom right, bottom left

    @classmethod
    def of(cls, found: Detections, stamp_ns: int) -> Spotted:
        """Return the markers of an image in which a map of markers alone was looked for."""
        markers, counts = np.unique(found.ids // 4, return_counts=True)
        pixels = found.pixels[np.argsort(found.ids)][np.repeat(counts == 4, counts)]
        return cls(stamp_ns, markers[counts == 4], pixels.reshape(-1, 4, 2))


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
        stamps = np.array([image.stamp_ns for image in self.spotted], np.int64)
        delay = middle_row_delay(self.camera, self.stamp_offset)
        return np.asarray(1e-9 * (stamps - stamps[0]) + delay)


@dataclass(frozen=True, slots=True)
class Chained:
    """Markers that hang together, and the images that show them."""

    markers: dict[int, Transform]  # origin_from_marker, by place in the list
    poses: dict[int, Transform]  # origin_from_camera, by place of the image
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
    between = _between(views, markers)
    pairs = np.array(list(between), np.int32).reshape(-1, 2)  # SciPy 1.11 has no trees of others
    costs = np.array([1.0 / support for _, support in between.values()])
    graph = csr_array((costs, (pairs[:, 0], pairs[:, 1])), shape=(len(markers),) * 2)
    tree = minimum_spanning_tree(graph)  # along the best supported chains
    _, labels = connected_components(tree, directed=False)
    groups = defaultdict[int, list[int]](list)
    for marker in sorted({sight.marker for view in views for sight in view}):
        groups[labels[marker]].append(marker)
    parts = sorted(groups.values(), key=lambda part: (-len(part), part[0]))
    first = parts[0][0] if origin is None else origin
    order, before = breadth_first_order(tree, first, directed=False)
    placed = {first: Transform(np.eye(3), np.zeros(3))}
    for here in order[1:].tolist():
        there = int(before[here])
        step = between[min(here, there), max(here, there)][0]
        placed[here] = placed[there] @ (step if there < here else step.inverse())
    poses = _image_poses(views, filmed.times(), placed, markers)
    return Chained(placed, poses, [part for part in parts if first not in part])


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
        fitting = zip(map(Transform, rotations, centres), fits, strict=True)
        poses = [(pose, fit) for pose, fit in fitting if pose.translation[2] > 0.0]
        if poses:
            sights.append(_MarkerSight(marker, rays, poses))
    return sights


def _between(
    views: list[list[_MarkerSight]], markers: Sequence[Marker]
) -> dict[tuple[int, int], tuple[Transform, float]]:
    """Return transforms a_from_b of each pair a < b, and the number of images that support them."""
    images = defaultdict[tuple[int, int], list[tuple[_MarkerSight, _MarkerSight]]](list)
    for view in views:
        for one, other in combinations(view, 2):  # in the order of their places
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
    best = int(np.argmax(per_image.sum(axis=1)))
    # The mean of what agrees with it, of each image one.
    weights = agree[best] * (agree[best] == per_image[best][np.searchsorted(image[firsts], image)])
    turn = Rotation.from_matrix(turns).mean(weights).as_matrix()
    return Transform(turn, weights @ places / weights.sum()), float(per_image[best].sum())


def _image_poses(
    views: list[list[_MarkerSight]], times: Array, placed: dict[int, Transform],
    markers: Sequence[Marker],
) -> dict[int, Transform]:  # fmt: skip
    """Return origin_from_camera of the images that tell it."""
    poses = dict[int, Transform]()
    for k, view in enumerate(views):
        own = [(sight, placed[sight.marker]) for sight in view if sight.marker in placed]
        if not own:
            continue
        shapes = [markers[of.marker].corners @ at.rotation.T + at.translation for of, at in own]
        points, rays = np.concatenate(shapes), np.concatenate([of.rays for of, _ in own])
        options = [pose @ place.inverse() for of, place in own for pose, _ in of.poses]
        costs = np.array([_cost(option, points, rays) for option in options])
        best = options[int(np.argmin(costs))]
        last = next(reversed(poses), None)
        if last is not None and times[k] - times[last] < _NEAR:
            before = poses[last].rotation
            alike = [options[m] for m in np.flatnonzero(costs <= _ALIKE * costs.min())]
            best = max(alike, key=lambda of: float(np.sum(of.rotation.T * before)))
        poses[k] = best.inverse()
    return poses


def _cost(pose: Transform, points: Array, rays: Array) -> float:
    """Return squared errors of points (n,3) under camera_from_origin, gross ones limited."""
    local = points @ pose.rotation.T + pose.translation
    ahead = local[:, 2] > 0.0
    depth = np.where(ahead, local[:, 2], 1.0)
    squared = np.sum((local[:, :2] / depth[:, None] - rays) ** 2, axis=1)
    return float(np.sum(np.where(ahead, np.minimum(squared, _GROSS**2), _GROSS**2)))
