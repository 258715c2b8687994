"""Every view of a recording on a first map: its pose, and the landmarks that it shows.

Keyframes lie too far apart to tell how the camera moved while one was read out. The images between
them do: each is localized with the rolling shutter, by the code of the node.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rs_localizer.config import Matching, NodeConfig
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.prior import Prior
from rs_localizer.io.keypoints import Keypoints
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.localizer import Localizer
from rs_localizer.mapping.views import View
from rs_localizer.matching import Matcher, Matches
from rs_localizer.tracking import Tracker

# A map that a global shutter has bent is off by more than good ones (px).
_THRESHOLD = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """Views with a pose, and what they show."""

    views: IntArray  # (k,) rows of the views that have a pose
    rotations: Array  # (k,3,3) map_from_camera at the middle row
    positions: Array  # (k,3) m
    seen_points: IntArray  # (n,) rows of the map
    seen_views: IntArray  # (n,) rows of the views
    pixels: Array  # (n,2) raw


def follow(
    views: Sequence[View],
    landmarks: Map,
    camera: Camera,
    done: Callable[[], object] = lambda: None,
) -> Followed:
    """Localize views in the order of their stamps.

    Args:
        landmarks: with descriptors of float32.
        camera: with its readout time; 0: a global shutter, or unknown.
    """
    one = _One(landmarks, camera)
    rows, estimates, seen = [], [], []
    for row, view in enumerate(views):
        found, matches = one.localize(view)
        if found:
            rows.append(row)
            estimates.append(found)
            kept = found.inliers
            pixels = view.features.pixels[matches.keypoints[kept]]
            seen.append((matches.landmarks[kept], np.full(len(pixels), row), pixels))
        done()
    empty = (np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))
    points, at, pixels = (np.concatenate(parts) for parts in zip(*seen, empty, strict=True))
    return Followed(
        np.array(rows, np.int64),
        np.array([estimate.rotation.T for estimate in estimates]).reshape(-1, 3, 3),
        np.array([estimate.position for estimate in estimates]).reshape(-1, 3),
        points,
        at,
        pixels,
    )


class _One:
    """One view after the other, as the node takes keypoints."""

    def __init__(self, landmarks: Map, camera: Camera) -> None:
        self._matcher, self._settings = Matcher(landmarks), Matching()
        self._localizer = Localizer(camera, NodeConfig(inlier_threshold=_THRESHOLD))
        self._tracker = Tracker(self._localizer) if camera.readout_time > 0.0 else None
        self._camera = camera

    def localize(self, view: View) -> tuple[Estimate | Failure, Matches]:
        seen = view.features
        keypoints = Keypoints(view.stamp_ns, seen.pixels, None, seen.descriptors, seen.scores, 0)
        if self._tracker is not None:
            prior = self._tracker.prediction(view.stamp_ns)
            if prior is not None:
                found, matches = self._match(keypoints, prior)
                if found:
                    return found, matches
        return self._match(keypoints, None)

    def _match(
        self, keypoints: Keypoints, prior: Prior | None
    ) -> tuple[Estimate | Failure, Matches]:
        matches = self._matcher.match(keypoints, self._settings, self._camera, prior)
        points = self._matcher.map.points[matches.landmarks]
        given = (points, keypoints.pixels[matches.keypoints], matches.scores)
        if self._tracker is None:
            return self._localizer.localize(*given), matches
        # The time from image to image is all that counts, not the row.
        return self._tracker.localize(keypoints.stamp_ns, *given), matches
