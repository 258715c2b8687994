# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Keypoints of known landmarks, and a first guess of all: what a map is refined from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.io.clouds import Correspondences
from rs_localizer.io.maps.landmarks import Map, make_map
from rs_localizer.tools.adjust.observe import ImagePoints, localize_each
from rs_localizer.tools.adjust.variables import Extrinsics, MountPrior
from rs_localizer.tools.mapping.gauge import Similarity
from rs_localizer.tools.readout_belief import ReadoutCheck

# A part of the map hangs together with another by at least this many landmarks.
_LEAST_IMAGES, _LEAST_SHARED = 3, 3
# Fewer observations hold a landmark on one ray, nearly.
_LEAST_OBSERVATIONS = 3
# Images of several cameras are taken together if they begin within this time (s): at 1 rad/s, a
# degree; what two images say of two markers may differ by eight.
_ONE_FRAME = 0.02
# An image with fewer keypoints does not know where it is.
LEAST_KEYPOINTS = 6


@dataclass(frozen=True, slots=True, eq=False)
class RigCamera:
    """A camera that a map is made with, of a rig or alone."""

    camera: Camera  # its readout time: 0: a global shutter, or it is to be found
    stamp_offset: float = 0.0  # s from a stamp to the first row's exposure, by the rig's clock
    mounting: MountPrior | None = None  # None: its axes are those of the rig

    @property
    def extrinsics(self) -> Extrinsics:
        """The mount as it is given."""
        return Extrinsics.none() if self.mounting is None else self.mounting.given

    @property
    def delay(self) -> float:
        """Seconds from a stamp to the middle row's exposure."""
        return self.stamp_offset - self.camera.readout_time * self.camera.first_row_time


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """A camera as the images say, when map and motion have been adjusted."""

    camera: Camera  # with its lens
    readout_time: float  # s; negative: against the scan direction
    readout_time_deviation: float  # s; NaN where it was given
    readout_check: ReadoutCheck | None  # of a given one; None: the images do not tell, or found
    extrinsics: Extrinsics
    deviations: Array  # (7,) of a step of the extrinsics: rad, m, s; zeros: they are the rig's axes


class RigImages(NamedTuple):
    """Images of several cameras, one of each at most, that were taken at about one time."""

    time: float  # s, mean of the images' middle rows
    images: list[tuple[int, int]]  # the camera, and its image


def frames_of(times: Sequence[Array]) -> list[RigImages]:
    """Group images by the times (g,), s, of each camera's."""
    every = sorted(
        (float(time), camera, image)
        for camera, own in enumerate(times)
        for image, time in enumerate(own)
    )
    groups: list[list[tuple[float, int, int]]] = []
    for one in every:
        last = groups[-1] if groups else []
        if last and one[0] - last[0][0] < _ONE_FRAME and one[1] not in {of[1] for of in last}:
            last.append(one)
        else:
            groups.append([one])
    return [
        RigImages(sum(of[0] for of in group) / len(group), [of[1:] for of in group])
        for group in groups
    ]  # fmt: skip


def frame_numbers(times: Array, cameras: IntArray) -> IntArray:
    """Return the frame of each image (g,), by its time (s) and its camera."""
    own = [np.flatnonzero(cameras == camera) for camera in range(int(cameras.max()) + 1)]
    numbers = np.empty(len(times), np.int64)
    for number, frame in enumerate(frames_of([times[images] for images in own])):
        for camera, image in frame.images:
            numbers[own[camera][image]] = number
    return numbers


@dataclass(frozen=True, slots=True, eq=False)
class MapObservations:
    """Keypoints of g images.

    Raises:
        ValueError: for arrays that do not go together.
    """

    stamps_ns: IntArray  # (g,) ns, of the images' headers; those of a camera rise
    images: IntArray  # (n,) rows of ``stamps_ns``
    landmarks: IntArray  # (n,) rows of ``Start.points``
    pixels: Array  # (n,2) raw
    cameras: IntArray | None = None  # (g,) of a rig, which of them; None: there is one

    @property
    def of_cameras(self) -> IntArray:
        """The camera of each image (g,)."""
        none = np.zeros(len(self.stamps_ns), np.int64)
        return none if self.cameras is None else self.cameras

    def __post_init__(self) -> None:
        count = len(self.images)
        if self.landmarks.shape != (count,) or self.pixels.shape != (count, 2):
            raise ValueError(
                f"images (n,), landmarks (n,) and pixels (n,2) must be of one length, got "
                f"{self.images.shape}, {self.landmarks.shape} and {self.pixels.shape}"
            )
        of = self.of_cameras
        if not all(np.all(np.diff(self.stamps_ns[of == k]) > 0) for k in np.unique(of)):
            raise ValueError("the images' stamps must rise")
        if count and not 0 <= self.images.min() <= self.images.max() < len(self.stamps_ns):
            raise ValueError("keypoints are of images without a stamp")


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
class MapFreedom:
    """Unknowns beside landmarks and motion, and their priors."""

    readout_time: bool = False
    lens: bool = False
    deviations: Array | None = None  # (p,) m, of the landmarks; infinite: not known at all
    angular_acceleration: float = 20.0  # rad/s^2, of the motion at first
    linear_acceleration: float = 10.0  # m/s^2
    # Standard deviations of the lens: focal lengths and centre by focal length, distortion.
    lens_deviations: tuple[float, float] = (0.02, 0.1)
    apart: bool = False  # nothing is known of the motion between images, of a global shutter
    drifts: int = 0  # how many of the errors that landmarks share are asked for


def shared_landmarks(observations: MapObservations) -> BoolArray:
    """Return a mask of landmarks (up to the last seen one) that two images or more see."""
    pairs = np.unique(np.column_stack([observations.landmarks, observations.images]), axis=0)
    return np.bincount(pairs[:, 0]) > 1


def check(observations: MapObservations, points: int, delays: Array) -> None:
    """Raise ValueError when the images do not make one map of this many points, and say why.

    Args:
        delays: (k,) s, of each camera's middle rows after their stamps.
    """
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
    times = 1e-9 * (observations.stamps_ns - observations.stamps_ns.min())
    frames = frame_numbers(times + delays[observations.of_cameras], observations.of_cameras)
    sizes = _parts(observations, shared[observations.landmarks], frames)
    if len(delays) > 1:  # an image without those of other cameras, as at the ends: by the motion
        sizes = [size for size in sizes if size > 1]
    if len(sizes) > 1:
        listed = ", ".join(str(size) for size in sizes[:6]) + (", ..." if len(sizes) > 6 else "")
        raise ValueError(
            f"the images fall into {len(sizes)} parts that share fewer than {_LEAST_SHARED} "
            f"landmarks (of {listed} images): refine each by itself, or record what joins them"
        )


def _parts(observations: MapObservations, usable: BoolArray, frames: IntArray) -> list[int]:
    """Number the connected parts of images, or of a rig's frames, largest first."""
    images, landmarks = frames[observations.images[usable]], observations.landmarks[usable]
    ones = np.ones(len(images))
    sees = coo_array((ones, (images, landmarks))).tocsr()
    sees.data[:] = 1.0
    common = (sees @ sees.T).tocsr()
    common.data = np.where(common.data >= _LEAST_SHARED, common.data, 0.0)
    common.eliminate_zeros()
    _, labels = connected_components(common, directed=False)
    present = np.unique(images)
    return sorted(np.unique(labels[present], return_counts=True)[1].tolist(), reverse=True)


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


def from_recordings(
    cameras: Sequence[Camera], clouds: Sequence[Sequence[Correspondences]],
    landmarks: Map | None = None, done: Callable[[], object] = lambda: None,
) -> RecordedMap:  # fmt: skip
    """Return images with a pose, and the landmarks that they show.

    Args:
        cameras: of a rig, or one alone, with their readout times, where these are known.
        clouds: of the recording of each, one an image.
        landmarks: the map; None: that of the recordings, by the points that they show.
        done: called after each image.

    Raises:
        ValueError: when points are not of the map, or no image has a pose.
    """
    images: list[tuple[int, Correspondences]] = []
    results: list[Estimate | Failure] = []
    for k, (camera, own) in enumerate(zip(cameras, clouds, strict=True)):
        once = {cloud.stamp_ns: cloud for cloud in own if len(cloud.points)}
        every = [once[stamp] for stamp in sorted(once)]
        images += [(k, cloud) for cloud in every]
        observed = [ImagePoints(cloud.stamp_ns, cloud.points, cloud.pixels) for cloud in every]
        results += localize_each(camera, observed, done)
    if landmarks is None:
        landmarks = _own_map([cloud for _, cloud in images])
    posed = [
        (k, cloud, result)
        for (k, cloud), result in zip(images, results, strict=True)
        if isinstance(result, Estimate)
    ]
    if not posed:
        raise ValueError(f"none of {len(images)} images has a pose; of the last one, {results[-1]}")
    near = [result.residuals < _MOST_RESIDUAL for _, _, result in posed]
    counts = [int(np.count_nonzero(of)) for of in near]
    seen = MapObservations(
        np.array([cloud.stamp_ns for _, cloud, _ in posed], np.int64),
        np.repeat(np.arange(len(posed)), counts),
        np.concatenate([
            _rows_of(landmarks, cloud)[of] for (_, cloud, _), of in zip(posed, near, strict=True)
        ]),
        np.concatenate([cloud.pixels[of] for (_, cloud, _), of in zip(posed, near, strict=True)]),
        np.array([k for k, _, _ in posed], np.int64),
    )  # fmt: skip
    start = Start(
        landmarks.points,
        np.array([result.rotation.T for _, _, result in posed]),
        np.array([result.position for _, _, result in posed]),
    )
    return RecordedMap(landmarks, seen, start, len(images))


def _own_map(clouds: Sequence[Correspondences]) -> Map:
    """Return the points of all clouds, with their ids if they have any."""
    points = np.concatenate([cloud.points for cloud in clouds])
    ids = None
    if all("id" in (cloud.table.dtype.names or ()) for cloud in clouds):
        every = np.concatenate([cloud.table["id"].astype(np.int64) for cloud in clouds])
        ids, firsts = np.unique(every, return_index=True)
        points = points[firsts]
    else:
        points = np.unique(points, axis=0)
    return make_map(points, ids, None, clouds[0].frame)


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
