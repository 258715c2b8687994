# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Markers whose places nobody knows: in single images, and a first guess chained over images.

A square seen alone fits two poses (Collins and Bartoli, *Infinitesimal plane-based pose
estimation*, IJCV 2014). Of two markers, what image after image says of how they lie to each other
agrees for the true poses only; by what agrees most, all are chained.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.io.transforms import Transform
from rs_localizer.markers.detection import Detections, MarkerDetector
from rs_localizer.markers.families import LEAST_SIDE, Family
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Marker
from rs_localizer.tools.mapping.map_keypoints import RigCamera, RigImages


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
        whole = _whole_markers(found, self._end)
        quads = [found.pixels[rows] for rows in whole.values()]
        return Spotted(stamp_ns, np.array(list(whole), np.int64), np.array(quads).reshape(-1, 4, 2))


def _whole_markers(detections: Detections, end: int) -> dict[int, IntArray]:
    """Return rows of the detections for each single marker of which all four corners were found."""
    place = {int(id_): row for row, id_ in enumerate(detections.ids) if id_ < end}
    markers = sorted({id_ // 4 for id_ in place})
    corners = {m: [place.get(4 * m + k, -1) for k in range(4)] for m in markers}
    return {m: np.array(rows) for m, rows in corners.items() if min(rows) >= 0}


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
class Filmed(RigCamera):
    """The images of one of the cameras."""

    spotted: Sequence[Spotted] = ()  # in the order of their stamps

    def times(self, start_ns: int) -> Array:
        """Return the times (g,), s, at which the images' middle rows were exposed."""
        stamps = np.array([(image.stamp_ns - start_ns) * 1e-9 for image in self.spotted])
        return stamps + self.delay


@dataclass(frozen=True, slots=True)
class Chained:
    """Markers that hang together, and the frames that show them."""

    sized: Sequence[Marker]  # all, with sizes to begin with where those that are said cannot be
    markers: dict[int, Transform]  # origin_from_marker, by place in the list
    frames: list[int]  # places of those with a pose
    poses: list[Transform]  # origin_from_rig
    apart: list[list[int]]  # markers that do not hang together with these, part by part


class _MarkerSight(NamedTuple):
    """A marker in an image of one of the cameras."""

    marker: int
    camera: int
    rays: Array  # (4,2)
    poses: list[tuple[Transform, float]]  # rig_from_marker, and how far it fits, of 1


@dataclass(frozen=True, slots=True, eq=False)
class _FrameView:
    """One frame: the markers of the images of all cameras that were taken at about one time."""

    time: float  # s
    sights: list[_MarkerSight]


def chain(
    filmed: Sequence[Filmed], frames: Sequence[RigImages], markers: Sequence[Marker],
    origin: int | None,
) -> Chained:  # fmt: skip
    """Place the markers that hang together with one of them.

    Args:
        filmed: by each camera.
        frames: the images that belong together, in the order of their times.
        markers: all there may be; only their sizes count.
        origin: place of the one whose frame is that of the others; None: the first of the most
            that hang together.
    """
    mounts = [Transform(m.axes, -m.axes @ m.centre) for m in (one.extrinsics for one in filmed)]
    views = [_view(filmed, mounts, frame, markers) for frame in frames]
    grown = {k: by for k, by in _growth(views).items() if abs(by) > _WRONG_SIZE}
    if grown:
        markers = [
            replace(marker, corners=math.exp(grown.get(k, 0.0)) * marker.corners)
            for k, marker in enumerate(markers)
        ]
        views = [_view(filmed, mounts, frame, markers) for frame in frames]
    seen = sorted({sight.marker for view in views for sight in view.sights})
    between, scores = _between(views, markers)
    parts = _parts(seen, scores)
    first = parts[0][0] if origin is None else origin
    own = next(part for part in parts if first in part)
    placed = _placed(first, own, between, scores)
    own_frames, poses = _frame_poses(views, mounts, placed, markers)
    apart = [part for part in parts if part is not own]
    return Chained(markers, placed, own_frames, poses, apart)


# Fewest images that compare the sizes of a pair of markers, and how well they must agree.
_LEAST_SEEN, _AGREE = 6, 0.9
_SIZE_ROUNDS = 10
# Sizes that are wrong by more than this share: a first guess needs others.
_WRONG_SIZE = 0.1


def _growth(views: Sequence[_FrameView]) -> dict[int, float]:
    """Return log sizes of markers over the given ones, beside most others.

    The camera's way about a marker of the wrong size is too long or too short by that: two markers
    of one image are at the same place beside each other whatever the way, which tells the ratio of
    both. Least absolute deviations over all pairs, and of sizes from those that are said: along a
    chain of pairs, ratios alone drift.
    """
    ways: dict[tuple[int, int], list[tuple[Array, Array]]] = {}
    for view in views:
        for one, other in combinations(sorted(view.sights, key=lambda of: of.marker), 2):
            if one.camera != other.camera or one.marker == other.marker:
                continue
            first, second = (max(of.poses, key=lambda pose: pose[1])[0] for of in (one, other))
            turn = first.rotation.T
            way = turn @ first.translation, turn @ second.translation
            ways.setdefault((one.marker, other.marker), []).append(way)
    rows = []
    for (a, b), every in ways.items():
        x, y = (np.array(of) - np.mean(of, axis=0) for of in zip(*every, strict=True))
        lengths = np.linalg.norm(x), np.linalg.norm(y)
        if len(every) >= _LEAST_SEEN and np.sum(x * y) > _AGREE * lengths[0] * lengths[1]:
            rows.append((a, b, np.log(lengths[0] / lengths[1])))
    numbers = sorted({marker for row in rows for marker in row[:2]})
    if not numbers:
        return {}
    said = np.eye(len(numbers))
    design = np.concatenate([np.zeros((len(rows), len(numbers))), said])
    ratios = np.array([row[2] for row in rows] + [0.0] * len(numbers))
    for k, (a, b, _) in enumerate(rows):
        design[k, numbers.index(a)], design[k, numbers.index(b)] = -1.0, 1.0
    found, weights = np.zeros(len(numbers)), np.ones(len(ratios))
    for _ in range(_SIZE_ROUNDS):
        root = np.sqrt(weights)
        found = np.linalg.lstsq(design * root[:, None], ratios * root, rcond=None)[0]
        weights = 1.0 / np.maximum(np.abs(design @ found - ratios), 1e-2)
    return dict(zip(numbers, (found - np.median(found)).tolist(), strict=True))


def _view(
    filmed: Sequence[Filmed], mounts: list[Transform], frame: RigImages, markers: Sequence[Marker]
) -> _FrameView:
    sights = []
    for place, image in frame.images:
        camera, spotted = filmed[place].camera, filmed[place].spotted[image]
        back = mounts[place].inverse()
        for marker, quad in zip(spotted.markers.tolist(), spotted.quads, strict=True):
            own = camera.rays(quad)
            found = _square_poses(markers[marker].corners, own, _SHUTTER / camera.focal_length)
            if np.isfinite(own).all() and found:
                found = [(back @ pose, fit) for pose, fit in found]
                sights.append(_MarkerSight(marker, place, own, found))
    return _FrameView(frame.time, sights)


def _square_poses(corners: Array, rays: Array, doubt: float) -> list[tuple[Transform, float]]:
    """Return poses camera_from_marker that fit rays (4,2), and their weights, of 1."""
    try:
        count, turns, places, errors = cv2.solvePnPGeneric(
            corners, np.ascontiguousarray(rays), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
    except cv2.error:
        return []
    fits = np.exp(-(np.ravel(errors) - np.min(errors)) / doubt)
    found = [
        (
            Transform(
                np.asarray(cv2.Rodrigues(turns[k])[0], np.float64),
                np.asarray(places[k], np.float64).ravel(),
            ),
            fits[k],
        )
        for k in range(count)
    ]
    return [(pose, float(fit)) for pose, fit in found if pose.translation[2] > 0.0]


def _between(
    views: list[_FrameView], markers: Sequence[Marker]
) -> tuple[dict[tuple[int, int], Transform], dict[tuple[int, int], float]]:
    """Return transforms a_from_b of each pair a < b, and the number of images that support them."""
    images: dict[tuple[int, int], list[tuple[_MarkerSight, _MarkerSight]]] = {}
    apart: dict[
        tuple[int, int], list[tuple[_MarkerSight, _MarkerSight]]
    ] = {}  # in images of two cameras
    for view in views:
        by_marker = sorted(view.sights, key=lambda sight: sight.marker)
        for one, other in combinations(by_marker, 2):
            if one.marker != other.marker:
                pairs = images if one.camera == other.camera else apart
                pairs.setdefault((one.marker, other.marker), []).append((one, other))
    between, scores = {}, {}
    for (a, b), among in (apart | images).items():
        step = -(-len(among) // _MOST_IMAGES)
        said = [
            (k, first.inverse() @ second, fit * other)
            for k, (one, two) in enumerate(among[::step])
            for first, fit in one.poses
            for second, other in two.poses
        ]
        size = max(markers[a].size, markers[b].size)
        between[a, b], scores[a, b] = _agreed(said, size)
        if (a, b) not in images:
            # The rig moves between images of two cameras: what one image says goes before.
            scores[a, b] /= len(views)
    return between, scores


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
    weights = np.where(
        agree[best] == per_image[best][np.searchsorted(image[firsts], image)], agree[best], 0.0
    )
    u, _, vt = np.linalg.svd(np.einsum("n,nij->ij", weights, turns))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return Transform(turn, weights @ places / weights.sum()), float(support[best])


def _parts(markers: list[int], scores: dict[tuple[int, int], float]) -> list[list[int]]:
    """Return connected markers, the largest part first."""
    place = {marker: k for k, marker in enumerate(markers)}
    pairs = np.array([[place[a], place[b]] for a, b in scores], np.int32).reshape(-1, 2)
    graph = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(markers),) * 2)
    count, labels = connected_components(graph, directed=False)
    parts = [[m for m, of in zip(markers, labels, strict=True) if of == k] for k in range(count)]
    return sorted(parts, key=lambda part: (-len(part), part[0]))


def _placed(
    origin: int, own: list[int], between: dict[tuple[int, int], Transform],
    scores: dict[tuple[int, int], float],
) -> dict[int, Transform]:  # fmt: skip
    """Return origin_from_marker along the best supported chains."""
    place = {marker: k for k, marker in enumerate(own)}
    inside = [(pair, score) for pair, score in scores.items() if pair[0] in place]
    # SciPy 1.11 has no trees of other indices.
    pairs = np.array([[place[a], place[b]] for (a, b), _ in inside], np.int32).reshape(-1, 2)
    costs = 1.0 / np.array([score for _, score in inside])
    tree = minimum_spanning_tree(
        csr_array((costs, (pairs[:, 0], pairs[:, 1])), shape=(len(own),) * 2)
    )
    order, before = breadth_first_order(tree, place[origin], directed=False)
    placed = {origin: Transform(np.eye(3), np.zeros(3))}
    for k in order[1:].tolist():
        here, there = own[k], own[int(before[k])]
        pair = (min(here, there), max(here, there))
        step = between[pair] if there < here else between[pair].inverse()
        placed[here] = placed[there] @ step
    return placed


def _frame_poses(
    views: list[_FrameView], mounts: list[Transform], placed: dict[int, Transform],
    markers: Sequence[Marker],
) -> tuple[list[int], list[Transform]]:  # fmt: skip
    """Return frames with a pose, and origin_from_rig of each."""
    frames: list[int] = []
    poses: list[Transform] = []
    for k, view in enumerate(views):
        own = [sight for sight in view.sights if sight.marker in placed]
        if not own:
            continue
        by_camera = [
            (
                mounts[place],
                np.concatenate([_corners(markers[of.marker], placed[of.marker]) for of in seen]),
                np.concatenate([of.rays for of in seen]),
            )
            for place in sorted({sight.camera for sight in own})
            for seen in [[sight for sight in own if sight.camera == place]]
        ]
        options = [pose @ placed[of.marker].inverse() for of in own for pose, _ in of.poses]
        costs = np.array([
            sum(_cost(mount @ option, points, rays) for mount, points, rays in by_camera)
            for option in options
        ])  # fmt: skip
        alike = [option for option, cost in zip(options, costs, strict=True)
                 if cost <= _ALIKE * costs.min()]  # fmt: skip
        best = options[int(np.argmin(costs))]
        near = frames and view.time - views[frames[-1]].time < _NEAR
        if near and len(alike) > 1:
            before = poses[-1].rotation
            best = max(alike, key=lambda option: float(np.sum(option.rotation.T * before)))
        frames.append(k)
        poses.append(best.inverse())
    return frames, poses


def _corners(marker: Marker, placed: Transform) -> Array:
    return np.asarray(marker.corners @ placed.rotation.T + placed.translation)


def _cost(pose: Transform, points: Array, rays: Array) -> float:
    """Return squared errors of points (n,3) under camera_from_origin, gross ones limited."""
    local = points @ pose.rotation.T + pose.translation
    ahead = local[:, 2] > 0.0
    depth = np.where(ahead, local[:, 2], 1.0)
    squared = np.sum((local[:, :2] / depth[:, None] - rays) ** 2, axis=1)
    return float(np.sum(np.where(ahead, np.minimum(squared, _GROSS**2), _GROSS**2)))
