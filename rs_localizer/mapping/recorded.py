"""Recorded correspondences and their map -> what a map is refined from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.types import Estimate
from rs_localizer.io.clouds import Correspondences
from rs_localizer.io.maps.landmarks import Map, make_map
from rs_localizer.mapping.observations import MapObservations, Start
from rs_localizer.trajectory.observe import Observed, localize_each

# A landmark in the wrong place is no outlier: keypoints count up to so many px beside the pose.
_MOST_RESIDUAL = 12.0


@dataclass(frozen=True, slots=True, eq=False)
class RecordedMap:
    """A map, and what the images of a recording show of it."""

    landmarks: Map
    seen: MapObservations
    start: Start
    images: int  # of the recording


def from_recording(
    camera: Camera, clouds: Sequence[Correspondences], landmarks: Map | None = None,
    done: Callable[[], object] = lambda: None,
) -> RecordedMap:  # fmt: skip
    """Images with a pose, and the landmarks that they show.

    Args:
        camera: with its readout time, where it is known.
        clouds: of the recording, one an image.
        landmarks: the map; None: that of the recording, by the points that it shows.
        done: called after each image.

    Raises:
        ValueError: when points are not of the map, or no image has a pose.
    """
    once = {cloud.stamp_ns: cloud for cloud in clouds if len(cloud.points)}
    images = [once[stamp] for stamp in sorted(once)]
    if landmarks is None:
        landmarks = _own_map(images)
    rows = [_rows_of(landmarks, cloud) for cloud in images]
    observed = [Observed(cloud.stamp_ns, cloud.points, cloud.pixels) for cloud in images]
    results = localize_each(camera, observed, done)
    posed = [k for k, result in enumerate(results) if isinstance(result, Estimate)]
    if not posed:
        raise ValueError(f"none of {len(images)} images has a pose; of the last one, {results[-1]}")
    found = [result for result in results if isinstance(result, Estimate)]
    near = [estimate.residuals < _MOST_RESIDUAL for estimate in found]
    counts = [int(np.count_nonzero(of)) for of in near]
    seen = MapObservations(
        np.array([images[k].stamp_ns for k in posed], np.int64),
        np.repeat(np.arange(len(posed)), counts),
        np.concatenate([rows[k][of] for k, of in zip(posed, near, strict=True)]),
        np.concatenate([images[k].pixels[of] for k, of in zip(posed, near, strict=True)]),
    )
    start = Start(
        landmarks.points,
        np.array([estimate.rotation.T for estimate in found]),
        np.array([estimate.position for estimate in found]),
    )
    return RecordedMap(landmarks, seen, start, len(images))


def _own_map(clouds: Sequence[Correspondences]) -> Map:
    """The points of all clouds, with their ids if they have any."""
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
    """The landmarks (n,) that the rows of a cloud show: by their ids, else by their places."""
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
    """Something that points (n,3) are the same by, (n,)."""
    single = np.ascontiguousarray(points, np.float32) + np.float32(0.0)
    return single.view([("", np.float32)] * 3).ravel()
