# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Keypoints of known landmarks, and a first guess of all: what a map is refined from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.types import Estimate
from rs_localizer.io.clouds import Correspondences
from rs_localizer.io.maps.landmarks import Map, make_map
from rs_localizer.tools.adjust.observe import in_order, localize_each
from rs_localizer.tools.adjust.spline import LONGEST_GAP, LONGEST_SPACING, Spline, spline_through
from rs_localizer.tools.adjust.variables import Freedom, Unknowns
from rs_localizer.tools.mapping.gauge import Similarity
from rs_localizer.tools.readout_belief import ReadoutCheck

# A stretch reaches so far beyond its images (s), half as long as readouts take; and this share of
# a known one.
_MARGIN, _MARGIN_SHARE = 0.025, 0.55
# Beyond this rotation (rad) between two images its direction is unknown: the video is cut, or a
# line of a survey flight ends.
_MOST_TURN = 0.5 * math.pi
# Images in a row of which the motion's own accelerations can be told.
_IN_A_ROW = 10
_LEAST_ACCELERATION = 0.5  # rad/s^2, m/s^2
ANGULAR_VELOCITY, LINEAR_VELOCITY = 2.0, 1.0
"""Velocity of images that stand alone, a hand that walks: rad/s, m/s."""


def following(times: Array, rotations: Array) -> BoolArray:
    """Return a mask (g - 1,) of images that follow the one before in one motion."""
    turns = Rotation.from_matrix(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
    return np.asarray((np.diff(times) <= LONGEST_GAP) & (turns.magnitude() < _MOST_TURN), np.bool_)


def initial_trajectory(
    times: Array, rotations: Array, positions: Array, readout_time: float,
    follow: BoolArray | None = None,
) -> Spline:  # fmt: skip
    """Return a spline near poses (g,3,3), (g,3), map_from_camera, at rising times (g,), s.

    Images that follow each other (g - 1,) are one stretch (None: those that are near in time); one
    that stands alone has a piece of its own.
    """
    steps = np.diff(times)
    near = steps <= LONGEST_GAP if follow is None else follow
    parts = np.split(np.arange(len(times)), np.flatnonzero(~near) + 1)
    spacing = min(LONGEST_SPACING, float(np.median(steps[near]))) if near.any() else LONGEST_SPACING
    margin = max(_MARGIN, _MARGIN_SHARE * abs(readout_time))
    # A stretch reaches up to half a spacing beyond its margins, and must not reach the next one.
    shortest = float(np.min(steps[~near], initial=np.inf))
    spacing, margin = min(spacing, 0.4 * shortest), min(margin, 0.25 * shortest)
    return spline_through(parts, times, rotations, positions, spacing, margin)


def acceleration_prior(state: Unknowns, freedom: Freedom) -> Freedom | None:
    """Return a prior of accelerations as large as the motion's own, if stretches suffice."""
    layout = state.spline.layout
    counts = np.diff(layout.firsts)
    long = np.repeat(counts >= _IN_A_ROW, counts)
    if not long.any():
        return None
    states = state.spline.states(layout.control_times()[long])
    angular, linear = (
        max(float(np.sqrt(np.mean(np.square(of)))), _LEAST_ACCELERATION)
        for of in (states.angular_acceleration, states.linear_acceleration)
    )
    return replace(freedom, angular_acceleration=angular, linear_acceleration=linear)


# A part of the map hangs together with another by at least this many landmarks.
_LEAST_IMAGES, _LEAST_SHARED = 3, 3
# Fewer observations hold a landmark on one ray, nearly.
_LEAST_OBSERVATIONS = 3
# An image with fewer keypoints does not know where it is; more than so many of it say little more,
# and cost time.
LEAST_KEYPOINTS, ADJUSTED = 6, 150


def middle_row_delay(camera: Camera, stamp_offset: float) -> float:
    """Return the time (s) from a stamp to the middle row's exposure.

    Args:
        stamp_offset: s from a stamp to the first row's exposure.
    """
    return stamp_offset - camera.readout_time * camera.first_row_time


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """A camera as the images say, when map and motion have been adjusted."""

    camera: Camera  # with its lens
    readout_time: float  # s; negative: against the scan direction
    readout_time_deviation: float  # s; NaN where it was given
    readout_check: ReadoutCheck | None  # of a given one; None: the images do not tell, or found


@dataclass(frozen=True, slots=True, eq=False)
class MapObservations:
    """Keypoints of g images."""

    stamps_ns: IntArray  # (g,) ns, of the images' headers; they rise
    images: IntArray  # (n,) rows of ``stamps_ns``
    landmarks: IntArray  # (n,) rows of ``Start.points``
    pixels: Array  # (n,2) raw


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A first guess: a map and where each image was taken."""

    points: Array  # (p,3) m, map frame
    rotations: Array  # (g,3,3) map_from_camera, of the middle row or of the whole image
    positions: Array  # (g,3) m, of the camera's centre in the map

    def moved(self, by: Similarity) -> Start:
        """Transform the first guess to another frame."""
        return Start(by(self.points), by.rotation @ self.rotations, by(self.positions))

    def local(self, seen: MapObservations) -> Array:
        """Return the landmarks of keypoints (n,3) in camera axes, as of a global shutter."""
        away = self.points[seen.landmarks] - self.positions[seen.images]
        return np.asarray(np.einsum("nji,nj->ni", self.rotations[seen.images], away))


@dataclass(frozen=True, slots=True, eq=False)
class MapFreedom(Freedom):
    """Unknowns beside landmarks and motion, and their priors."""

    readout_time: bool = False
    angular_acceleration: float = 20.0  # rad/s^2, of the motion at first
    linear_acceleration: float = 10.0  # m/s^2
    angular_velocity: float = ANGULAR_VELOCITY
    linear_velocity: float = LINEAR_VELOCITY
    deviations: Array | None = None  # (p,) m, of the landmarks; infinite: not known at all
    apart: bool = False  # nothing is known of the motion between images, of a global shutter
    drifts: int = 0  # how many of the errors that landmarks share are asked for


def shared_landmarks(observations: MapObservations) -> BoolArray:
    """Return a mask of landmarks (up to the last seen one) that two images or more see."""
    pairs = np.unique(np.column_stack([observations.landmarks, observations.images]), axis=0)
    return np.bincount(pairs[:, 0]) > 1


def check(observations: MapObservations, points: int) -> None:
    """Raise ValueError when the images do not make one map of this many points, and say why."""
    rows = observations.landmarks
    if len(rows) and not 0 <= rows.min() <= rows.max() < points:
        raise ValueError(f"keypoints are of landmarks that are not among the {points} of the map")
    if len(observations.stamps_ns) < _LEAST_IMAGES:
        raise ValueError(
            f"{len(observations.stamps_ns)} images show the map, at least {_LEAST_IMAGES} are "
            "needed"
        )
    shared = shared_landmarks(observations) if len(observations.images) else np.zeros(0, np.bool_)
    if not shared.any():
        raise ValueError("no overlap: no landmark is seen by two images")
    usable = shared[observations.landmarks]
    images, landmarks = observations.images[usable], observations.landmarks[usable]
    sees = coo_array((np.ones(len(images)), (images, landmarks))).tocsr()
    sees.data[:] = 1.0
    common = (sees @ sees.T).tocsr()
    common.data = np.where(common.data >= _LEAST_SHARED, common.data, 0.0)
    common.eliminate_zeros()
    labels = connected_components(common, directed=False)[1][np.unique(images)]
    sizes = sorted(np.unique(labels, return_counts=True)[1].tolist(), reverse=True)
    if len(sizes) > 1:
        listed = ", ".join(map(str, sizes[:6])) + (", ..." if len(sizes) > 6 else "")
        raise ValueError(
            f"the images fall into {len(sizes)} parts that share fewer than {_LEAST_SHARED} "
            f"landmarks (of {listed} images): refine each by itself, or record what joins them"
        )


def most_observed(landmarks: IntArray, images: IntArray, wanted: int) -> BoolArray:
    """Return a mask of the most observed landmarks; more, if half of an image needs them.

    Args:
        landmarks, images: (n,) of each keypoint.
        wanted: keypoints of each image.
    """
    order = np.argsort(landmarks, kind="stable")
    count = int(landmarks.max(initial=-1)) + 1
    starts = np.searchsorted(landmarks[order], np.arange(count + 1))
    counts = np.zeros(int(images.max(initial=-1)) + 1, np.int64)
    chosen = np.zeros(count, np.bool_)
    for landmark in np.argsort(-np.diff(starts), kind="stable").tolist():
        at = images[order[starts[landmark] : starts[landmark + 1]]]
        if len(at) < _LEAST_OBSERVATIONS:
            break
        if np.mean(counts[at] < wanted) >= 0.5:
            chosen[landmark] = True
            counts[at] += 1
    return chosen


def adjusted_part(
    seen: MapObservations, start: Start, wanted: int, least: int = 1
) -> tuple[IntArray, MapObservations, Start]:
    """Return images (k,) with the most observed landmarks, and what they show of these.

    Args:
        wanted: keypoints of each image.
        least: images with fewer are left out.
    """
    of = most_observed(seen.landmarks, seen.images, wanted)[seen.landmarks]
    of &= (np.bincount(seen.images[of], minlength=len(seen.stamps_ns)) >= least)[seen.images]
    used, images = np.unique(seen.images[of], return_inverse=True)
    return (
        used,
        MapObservations(seen.stamps_ns[used], images, seen.landmarks[of], seen.pixels[of]),
        Start(start.points, start.rotations[used], start.positions[used]),
    )


# A landmark in the wrong place is no outlier: keypoints count up to this many px beside the pose.
_MOST_RESIDUAL = 12.0


@dataclass(frozen=True, slots=True, eq=False)
class RecordedMap:
    """A map, and what the images of a recording show of it."""

    landmarks: Map
    seen: MapObservations
    start: Start
    images: int  # of the recording


def from_recording(
    camera: Camera, clouds: Sequence[Correspondences], landmarks: Map | None = None
) -> RecordedMap:
    """Return images with a pose, and the landmarks that they show.

    Args:
        camera: with its readout time, where that is known.
        clouds: one an image.
        landmarks: the map; None: that of the recording, by the points that it shows.

    Raises:
        ValueError: when points are not of the map, or no image has a pose.
    """
    images = in_order(clouds)
    results = localize_each(camera, images)
    if landmarks is None:
        landmarks = _own_map(images)
    posed = [
        (cloud, result, result.residuals < _MOST_RESIDUAL)
        for cloud, result in zip(images, results, strict=True)
        if isinstance(result, Estimate)
    ]
    if not posed:
        raise ValueError(f"none of {len(images)} images has a pose; of the last one, {results[-1]}")
    seen = MapObservations(
        np.array([cloud.stamp_ns for cloud, _, _ in posed], np.int64),
        np.repeat(np.arange(len(posed)), [np.count_nonzero(near) for _, _, near in posed]),
        np.concatenate([_rows_of(landmarks, cloud)[near] for cloud, _, near in posed]),
        np.concatenate([cloud.pixels[near] for cloud, _, near in posed]),
    )
    start = Start(
        landmarks.points,
        np.array([result.rotation.T for _, result, _ in posed]),
        np.array([result.position for _, result, _ in posed]),
    )
    return RecordedMap(landmarks, seen, start, len(images))


def _own_map(clouds: Sequence[Correspondences]) -> Map:
    """Return the points of all clouds, with their ids if they have any."""
    points = np.concatenate([cloud.points for cloud in clouds])
    if all("id" in (cloud.table.dtype.names or ()) for cloud in clouds):
        every = np.concatenate([cloud.table["id"].astype(np.int64) for cloud in clouds])
        ids, firsts = np.unique(every, return_index=True)
        return make_map(points[firsts], ids, None, clouds[0].frame)
    return make_map(np.unique(points, axis=0), None, None, clouds[0].frame)


def _rows_of(landmarks: Map, cloud: Correspondences) -> IntArray:
    """Return the landmarks (n,) of the rows of a cloud, by their ids, else by their places."""
    names = cloud.table.dtype.names or ()
    if landmarks.ids is not None and "id" in names:
        wanted: NDArray[Any] = cloud.table["id"].astype(np.int64)
        known: NDArray[Any] = landmarks.ids
    else:
        # A cloud may hold its points in single precision.
        wanted, known = _keys(cloud.points), _keys(landmarks.points)
    order = np.argsort(known)
    places = np.minimum(np.searchsorted(known[order], wanted), len(known) - 1)
    rows: IntArray = order[places]
    missing = int(np.count_nonzero(known[rows] != wanted))
    if missing:
        raise ValueError(
            f"{missing} of {len(wanted)} points of the image at {cloud.stamp_ns} ns are not in the "
            "map; is it the map of this recording?"
        )
    return rows


def _keys(points: Array) -> NDArray[Any]:
    """Return keys (n,) by which points (n,3) are compared."""
    single = np.ascontiguousarray(points, np.float32) + np.float32(0.0)
    return single.view([("", np.float32)] * 3).ravel()
