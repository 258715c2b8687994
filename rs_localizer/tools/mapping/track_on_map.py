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
from rs_localizer.io.bags import make_message
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.images import Image
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.recording import CAMERA_FRAME, MAP_FRAME, make_camera_info
from rs_localizer.offline.replay import inlier_columns
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.pipeline.keypoints import Extracted, keypoints
from rs_localizer.tools.mapping.map_keypoints import MapObservations, Start
from rs_localizer.tools.mapping.seen_images import SeenImage
from rs_localizer.tools.mapping.structure import Structure

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
    frames = _frames(structure, camera)
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
            image = Image(view.stamp_ns, CAMERA_FRAME, np.zeros((0, 0), np.uint8))
            found = frames.localize_keypoints(
                keypoints(Extracted(image, view.features), make_message)
            )
            if found:
                poses.append((found.estimate.rotation.T, found.estimate.position))
                points.append(found.inliers["id"].astype(np.int64))
                pixels.append(inlier_columns(found, "uv"))
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


def _frames(structure: Structure, camera: Camera) -> CameraFrames:
    """Return what localizes keypoints on the structure, as the node does."""
    config = NodeConfig(
        inlier_threshold=_THRESHOLD, readout_time=camera.readout_time,
        scan_direction=str(camera.scan_direction),
    )  # fmt: skip
    frames = CameraFrames(config)
    frames.calibrate(read_camera_info(make_camera_info(camera, 0)))
    points = structure.start.points
    frames.use_map(Map(points, np.arange(len(points)), structure.descriptors, MAP_FRAME))
    return frames
