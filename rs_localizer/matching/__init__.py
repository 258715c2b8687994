# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Keypoints of an image and landmarks of a map -> correspondences.

By the ids of landmarks, or by descriptors: of the two landmarks with the nearest descriptors the
first must be clearly nearer (Lowe's ratio test), and no other keypoint may be nearer to it. Where
the motion is predicted, only landmarks compete that are predicted near the keypoint.

Every search is exact and repeatable. On two cores, 500 descriptors of 32 bytes among 100,000 take
OpenCV's brute-force matcher 0.5 s, and its approximate one gives other matches in every run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion
from rs_localizer.estimation.prior import Prior, state_in
from rs_localizer.io.clouds import Correspondences, Keypoints, make_rows
from rs_localizer.io.maps.landmarks import Descriptors, Ids, Map
from rs_localizer.matching.kernels import (
    BestFound,
    Near,
    in_view,
    move,
    nearest_binary,
    nearest_binary_within,
    nearest_real_within,
)

# Largest ratio of the distances to the nearest and the second-nearest landmark: it refuses 90 % of
# the wrong matches and 5 % of the right ones (Lowe, IJCV 2004).
_RATIO = 0.8
_WORD_BYTES = 8
_WORDS_AT_ONCE = 4
# Numbers in a block of products of keypoints and landmarks: 32 MB.
_MOST_PRODUCTS = 8_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """The two nearest landmarks of each keypoint; -1 at an infinite distance: none."""

    distances: Array  # (q,2)
    landmarks: IntArray  # (q,2)

    @classmethod
    def none(cls, count: int) -> Nearest:
        return cls(np.full((count, 2), np.inf), np.full((count, 2), -1, np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class Visible:
    """Landmarks and where they are predicted, in the order of the second coordinate."""

    landmarks: IntArray  # (v,)
    pixels: Array  # (v,2)
    gate: float  # px


class Index:
    """A search among the descriptors (n,d) that it was made of.

    Bits are compared by how many of them differ, numbers by their Euclidean distance.
    """

    def __init__(self, descriptors: Descriptors, *, binary: bool) -> None:
        self._binary = binary
        self._rows = self._packed(descriptors)  # (n,w) as the kernels take them
        if binary:
            self._columns = np.ascontiguousarray(self._rows.T)
        else:
            with np.errstate(over="ignore"):
                self._squares = np.square(self._rows).sum(axis=1)

    def nearest(self, queries: Descriptors) -> Nearest:
        """Find the two nearest of all descriptors for queries (q,d)."""
        result, packed = Nearest.none(len(queries)), self._packed(queries)
        if not self._binary:
            return self._nearest_numbers(packed, result)
        nearest_binary(packed, self._columns, result.distances, result.landmarks)
        return result

    def nearest_within(
        self, queries: Descriptors, pixels: Array, visible: Visible
    ) -> tuple[Nearest, IntArray]:
        """Find the nearest landmarks predicted near pixels (q,2), and their nearest query (v,)."""
        result, count = Nearest.none(len(queries)), len(visible.landmarks)
        owners = np.full(count, -1, np.int64)
        near = Near(pixels, visible.landmarks, visible.pixels, visible.gate)
        best = BestFound(result.distances, result.landmarks, np.full(count, np.inf), owners)
        search = nearest_binary_within if self._binary else nearest_real_within
        search(self._packed(queries), self._rows, near, best)
        return result, owners

    def _packed(self, descriptors: Descriptors) -> NDArray[Any]:
        """Return numbers as they are, bytes (n,d) as words (n,w), w a multiple of four."""
        if not self._binary:
            return np.array(descriptors, np.float32)
        count, width = descriptors.shape
        chunk = _WORD_BYTES * _WORDS_AT_ONCE
        padded = np.zeros((count, -(-width // chunk) * chunk), np.uint8)
        padded[:, :width] = descriptors
        return padded.view(np.uint64)

    def _nearest_numbers(self, queries: NDArray[np.float32], result: Nearest) -> Nearest:
        block = max(1, _MOST_PRODUCTS // len(self._rows))
        # Points that overflow are far away, or nowhere.
        with np.errstate(over="ignore", invalid="ignore"):
            for start in range(0, len(queries), block):
                part = slice(start, start + block)
                products = queries[part] @ self._rows.T
                products *= -2.0
                products += self._squares  # but for a constant of each query
                for column in range(min(2, len(self._rows))):
                    best = products.argmin(axis=1)
                    offsets = queries[part].astype(np.float64) - self._rows[best]
                    result.landmarks[part, column] = best
                    result.distances[part, column] = np.sqrt(np.square(offsets).sum(axis=1))
                    products[np.arange(len(best)), best] = np.inf
        # Rounding of the products may have swapped them.
        order = np.argsort(result.distances, axis=1, kind="stable")
        return Nearest(
            np.take_along_axis(result.distances, order, 1),
            np.take_along_axis(result.landmarks, order, 1),
        )


# Standard deviations of the prediction within which the camera is looked for.
_DEVIATIONS = 3.0
# Pixels around its prediction in which a landmark is looked for at least: some ten times the error
# of a tracked prediction of a hand-held camera.
_GATE = 20.0
MOST_KEYPOINTS = 2000
"""Of a frame, matched by descriptor: those with the best scores, or the first ones. A frame needs
some hundreds, and detectors give one to two thousand."""
# Pixels along each border of the image that bound its bearings.
_BORDER_PIXELS = 33


def predict_visible(camera: Camera, prior: Prior, points: Array, least_gate: float) -> Visible:
    """Predict the pixels of the landmarks that some row may see, each at the time of its own row.

    Args:
        camera: of the image.
        prior: predicted motion and its covariance.
        points: (n,3) of the map.
        least_gate: px; the gate is wider where the prediction is less certain than that.
    """
    assert prior.motion is not None
    assert prior.covariance is not None
    low, high = _bearings(camera)
    widest = 0.5 * math.hypot(*camera.size)
    focal = camera.focal_length
    slack = min(2.0 * least_gate, widest) / focal
    depths = np.empty(len(points))
    in_view(points, state_in(prior.motion, np.zeros(3)), low - slack, high + slack, depths)
    near = np.flatnonzero(depths)
    if len(near) == 0:
        return Visible(near, np.zeros((0, 2)), least_gate)
    deviation = focal * _bearing_deviation(prior.covariance, float(np.median(depths[near])))
    gate = float(min(max(least_gate, _DEVIATIONS * deviation), widest))
    pixels = _project(camera, prior.motion, points[near])
    limit = np.array(camera.size) - 0.5 + gate
    inside = np.flatnonzero(np.all((pixels > -0.5 - gate) & (pixels < limit), axis=1))
    order = inside[np.argsort(pixels[inside, 1], kind="stable")]
    return Visible(near[order], pixels[order], gate)


def _project(camera: Camera, motion: Motion, points: Array) -> Array:
    """Project points (n,3) to raw pixels (n,2), each at the time of its row; NaN behind.

    One step of what :func:`rs_localizer.core.shutter.project_rolling` does until no digit changes:
    to a small part of a pixel, in a fifth of the time.
    """
    state, moved = state_in(motion, np.zeros(3)), np.empty(points.shape)

    def view(tau: Array) -> Array:
        move(points, state, tau, moved)
        return camera.project(moved)

    rows = camera.row_time(view(np.zeros(len(points))))
    error = camera.row_time(view(rows)) - rows
    with np.errstate(all="ignore"):  # NaN, and points in the middle row
        step = -error * rows / (error - rows)
    return view(np.clip(rows + np.nan_to_num(step), -1.0, 1.0))


def _bearings(camera: Camera) -> tuple[Array, Array]:
    """Return bounds (2,), (2,) of the bearings in the image; infinite if the lens sees sideways."""
    u, v = (np.linspace(-0.5, size - 0.5, _BORDER_PIXELS) for size in camera.size)
    # The lines of a grid's border.
    columns, rows = np.meshgrid(u, v)
    rim = (columns == u[0]) | (columns == u[-1]) | (rows == v[0]) | (rows == v[-1])
    rays = camera.rays(np.column_stack([columns[rim], rows[rim]]))
    if not np.all(np.isfinite(rays)):
        return np.full(2, -np.inf), np.full(2, np.inf)
    return rays.min(axis=0), rays.max(axis=0)


def _bearing_deviation(covariance: Array, depth: float) -> float:
    """Return the standard deviation of a point's bearing at a depth, at the first or last row."""
    turn, move, angular, linear = (
        float(np.linalg.eigvalsh(covariance[k : k + 3, k : k + 3])[-1]) for k in (0, 3, 6, 9)
    )
    return math.sqrt(turn + 0.25 * angular + (move + 0.25 * linear) / depth**2)


class MatchBy(StrEnum):
    """Basis of the comparison of keypoints with landmarks."""

    DESCRIPTOR = "descriptor"
    ID = "id"


class MatchError(ValueError):
    """Keypoints that cannot be compared with the map; the text says what was found."""


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Which keypoint shows which landmark, each at most once."""

    keypoints: IntArray  # (k,)
    landmarks: IntArray  # (k,)
    scores: Array | None  # (k,) higher is better
    by: MatchBy  # id or descriptor

    def __len__(self) -> int:
        return len(self.keypoints)


class Matcher:
    """A map, ready to be recognized."""

    def __init__(self, landmarks: Map) -> None:
        self.map = landmarks
        self._order: IntArray | None = None
        if landmarks.ids is not None:
            self._order = np.argsort(landmarks.ids, kind="stable")
            self._sorted: Ids = landmarks.ids[self._order]
        self._index: Index | None = None
        if landmarks.descriptors is not None:
            binary = landmarks.descriptors.dtype == np.uint8
            self._index = Index(landmarks.descriptors, binary=binary)

    def match(
        self, keypoints: Keypoints, camera: Camera | None = None, prior: Prior | None = None
    ) -> Matches:
        """Match keypoints with the map.

        Args:
            keypoints: of one image.
            camera, prior: with a predicted motion, where the landmarks are looked for.

        Raises:
            MatchError: when keypoints and map have nothing in common to be compared by.
        """
        if self.choose(keypoints) == MatchBy.ID:
            return self._by_id(keypoints)
        assert keypoints.descriptors is not None
        chosen = _best(keypoints, MOST_KEYPOINTS)
        queries, pixels = keypoints.descriptors[chosen], keypoints.pixels[chosen]
        if camera is not None and prior is not None:
            matches, owners = self._predicted(queries, pixels, camera, prior)
        else:
            matches, owners = self._anywhere(queries)
        return _accepted(matches, owners, chosen)

    def choose(self, keypoints: Keypoints) -> MatchBy:
        """Choose what is compared: ids, or descriptors, which say more than a tracker's numbers.

        Raises:
            MatchError: when keypoints and map have nothing in common to be compared by.
        """
        both = {
            MatchBy.DESCRIPTOR: self._index is not None and keypoints.descriptors is not None,
            MatchBy.ID: self._order is not None and keypoints.ids is not None,
        }
        by = next((by for by, possible in both.items() if possible), None)
        if by is None:
            raise MatchError(
                f"keypoints and map cannot be compared by {' or '.join(both)}: the keypoints "
                f"have {_marks(keypoints.ids, keypoints.descriptors)}, the map has "
                f"{_marks(self.map.ids, self.map.descriptors)}"
            )
        sent, ours = keypoints.descriptors, self.map.descriptors
        if by == MatchBy.DESCRIPTOR and sent is not None and ours is not None:
            # SIFT is sent in bytes and in floats, which are the same numbers.
            kinds_fit = sent.dtype == ours.dtype or ours.dtype == np.float32
            if not kinds_fit or sent.shape[1] != ours.shape[1]:
                raise MatchError(f"the keypoints have {_kind(sent)}, the map has {_kind(ours)}")
        return by

    def _by_id(self, keypoints: Keypoints) -> Matches:
        assert keypoints.ids is not None
        assert self._order is not None
        places = np.searchsorted(self._sorted, keypoints.ids)
        places[places == len(self._sorted)] = 0
        common = np.flatnonzero(self._sorted[places] == keypoints.ids)
        # An id that comes twice shows the landmark where the score is best, or first.
        if keypoints.scores is not None:
            common = common[np.argsort(-keypoints.scores[common], kind="stable")]
        _, firsts = np.unique(keypoints.ids[common], return_index=True)
        rows = np.sort(common[firsts])
        scores = None if keypoints.scores is None else keypoints.scores[rows]
        return Matches(rows, self._order[places[rows]], scores, MatchBy.ID)

    def _anywhere(self, queries: Descriptors) -> tuple[Nearest, IntArray]:
        """Return the two landmarks nearest to each query, and the query nearest to the first one.

        A landmark that is nearer to another query (q,) is no match of this one.
        """
        assert self._index is not None
        assert self.map.descriptors is not None
        nearest = self._index.nearest(queries)
        owners = np.arange(len(queries))
        if len(queries):
            firsts = nearest.landmarks[:, 0]
            there = np.flatnonzero(firsts >= 0)
            # Descriptors are read as the map's: its bytes are bits, those of keypoints may stand
            # for numbers.
            index = Index(queries, binary=self.map.descriptors.dtype == np.uint8)
            back = index.nearest(self.map.descriptors[firsts[there]])
            owners[there] = back.landmarks[:, 0]
        return nearest, owners

    def _predicted(
        self, queries: Descriptors, pixels: Array, camera: Camera, prior: Prior
    ) -> tuple[Nearest, IntArray]:
        """Find the two nearest of the landmarks predicted near each query, and its rival (q,)."""
        assert self._index is not None
        visible = predict_visible(camera, prior, self.map.points, _GATE)
        nearest, owners = self._index.nearest_within(queries, pixels, visible)
        owner_of = np.full(len(self.map), -1, np.int64)
        owner_of[visible.landmarks] = owners
        return nearest, owner_of[nearest.landmarks[:, 0]]


def correspondences(matches: Matches, keypoints: Keypoints, landmarks: Map) -> Correspondences:
    """Return the matches as a cloud of correspondences, with the ids of the landmarks."""
    points, pixels = landmarks.points[matches.landmarks], keypoints.pixels[matches.keypoints]
    kinds: list[tuple[str, Any]] = [(name, landmarks.point_type) for name in "xyz"]
    kinds += [("u", "<f4"), ("v", "<f4")]
    columns: list[NDArray[Any]] = [*points.T, *pixels.T]
    if landmarks.ids is not None:
        kinds.append(("id", landmarks.id_type))
        columns.append(landmarks.ids[matches.landmarks])
    if matches.scores is not None:
        kinds.append(("score", "<f4"))
        columns.append(matches.scores)
    with np.errstate(over="ignore"):  # pixels of 1e300 are no pixels in single precision either
        table = make_rows(kinds, columns)
    stamp_ns, dropped = keypoints.stamp_ns, keypoints.dropped
    return Correspondences(
        stamp_ns, landmarks.frame, points, pixels, matches.scores, dropped, table
    )


def _best(keypoints: Keypoints, most: int) -> IntArray:
    """Return the best keypoints, in their own order."""
    count = len(keypoints)
    if count <= most:
        return np.arange(count)
    if keypoints.scores is None:
        return np.arange(most)
    return np.sort(np.argsort(-keypoints.scores, kind="stable")[:most])


def _accepted(nearest: Nearest, owners: IntArray, rows: IntArray) -> Matches:
    """Accept matches by ratio; the score is how much nearer the first landmark is."""
    first, second = nearest.distances[:, 0], nearest.distances[:, 1].copy()
    rivals = np.isfinite(second)
    if np.any(rivals):
        # If no other landmark competes, the second-best distance is the median one of other
        # keypoints.
        second[~rivals] = np.median(second[rivals])
    with np.errstate(invalid="ignore"):  # infinite against infinite: nothing there
        good = (first < _RATIO * second) & (owners == np.arange(len(first)))
    queries = np.flatnonzero(good)
    scores = 1.0 - first[queries] / second[queries]
    return Matches(rows[queries], nearest.landmarks[queries, 0], scores, MatchBy.DESCRIPTOR)


def _marks(ids: Ids | None, descriptors: Descriptors | None) -> str:
    names = [] if ids is None else ["ids"]
    names += [] if descriptors is None else [_kind(descriptors)]
    return " and ".join(names) or "neither"


def _kind(descriptors: Descriptors) -> str:
    return f"descriptors of {descriptors.shape[1]} x {descriptors.dtype}"
