# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Views on a first map: the pose of each, and the landmarks that it shows.

Keyframes may lie too far apart to tell how the camera moved while one was read out. The images
between them do: each is localized with the rolling shutter, by the code of the node.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.prior import Prior
from rs_localizer.io.clouds import Keypoints
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.localizer import Localizer
from rs_localizer.matching import Matcher, Matches
from rs_localizer.tools.mapping.map_keypoints import MapObservations, Start
from rs_localizer.tools.mapping.seen_images import SeenImage
from rs_localizer.tools.mapping.structure import Structure
from rs_localizer.tracking import Tracker

# A map that a global shutter has bent is off by more than good ones (px).
_THRESHOLD = 4.0


def track_on_map(
    views: Sequence[SeenImage],
    structure: Structure,
    camera: Camera,
    done: Callable[[], object] = lambda: None,
) -> tuple[IntArray, MapObservations, Start]:
    """Return rows (k,) of the views with a pose, and what they show.

    Keyframes are where COLMAP has them, the others are localized.

    Args:
        views: in the order of their stamps.
        structure: of about the right size, in metres.
        camera: with its readout time; 0: a global shutter, or unknown.
        done: called after each view.
    """
    seen, start = structure.seen, structure.start
    tracker = _MapTracker(Map(start.points, None, structure.descriptors, "map"), camera)
    ends = np.searchsorted(seen.images, np.arange(len(structure.views) + 1)).tolist()
    keyframes = {view: k for k, view in enumerate(structure.views.tolist())}
    rows, poses, points, pixels = [], [], [], []
    for row, view in enumerate(views):
        k = keyframes.get(row)
        if k is not None:
            own = slice(ends[k], ends[k + 1])
            poses.append((start.rotations[k], start.positions[k]))
            points.append(seen.landmarks[own])
            pixels.append(seen.pixels[own])
            rows.append(row)
        else:
            estimate, matches = tracker.localize(view)
            if estimate:
                poses.append((estimate.rotation.T, estimate.position))
                points.append(matches.landmarks[estimate.inliers])
                pixels.append(view.features.pixels[matches.keypoints[estimate.inliers]])
                rows.append(row)
        done()
    counts = [len(of) for of in points]
    shown = MapObservations(
        np.array([views[row].stamp_ns for row in rows], np.int64),
        np.repeat(np.arange(len(rows)), counts),
        np.concatenate([*points, np.zeros(0, np.int64)]),
        np.concatenate([*pixels, np.zeros((0, 2))]),
    )
    rotations = np.array([rotation for rotation, _ in poses]).reshape(-1, 3, 3)
    positions = np.array([position for _, position in poses]).reshape(-1, 3)
    return np.array(rows, np.int64), shown, Start(start.points, rotations, positions)


class _MapTracker:
    """One view after the other, as the node takes keypoints."""

    def __init__(self, landmarks: Map, camera: Camera) -> None:
        self._matcher = Matcher(landmarks)
        self._localizer = Localizer(camera, NodeConfig(inlier_threshold=_THRESHOLD))
        self._tracker = Tracker(self._localizer) if camera.readout_time > 0.0 else None
        self._camera = camera

    def localize(self, view: SeenImage) -> tuple[Estimate | Failure, Matches]:
        features = view.features
        keypoints = Keypoints(
            view.stamp_ns, features.pixels, None, features.descriptors, features.scores, 0
        )
        if self._tracker is not None:
            prior = self._tracker.prediction(view.stamp_ns)
            if prior is not None:
                estimate, matches = self._match(keypoints, prior)
                if estimate:
                    return estimate, matches
        return self._match(keypoints, None)

    def _match(
        self, keypoints: Keypoints, prior: Prior | None
    ) -> tuple[Estimate | Failure, Matches]:
        matches = self._matcher.match(keypoints, self._camera, prior)
        points = self._matcher.map.points[matches.landmarks]
        cloud = (points, keypoints.pixels[matches.keypoints], matches.scores)
        if self._tracker is None:
            return self._localizer.localize(*cloud), matches
        # The time from image to image is all that counts, not the row.
        return self._tracker.localize(keypoints.stamp_ns, *cloud), matches
