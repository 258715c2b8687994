# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Cubes stand on their markers, each point of them at the time of the row that sees it."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.markers.detection import Detections, MarkerQuads
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.markers.overlay import CameraPath, draw_world

K = np.array([[400.0, 0.0, 319.5], [0.0, 400.0, 239.5], [0.0, 0.0, 1.0]])
READOUT = 0.03
CAMERA = Camera(640, 480, K, readout_time=READOUT)
MAP = MarkerMap(wall("4x4_50", (2, 1), 0.2, 0.2))
# Before the wall, turning fast and walking.
POSITION = np.array([0.05, 0.1, 1.0])
ANGULAR, LINEAR = np.array([2.0, -3.0, 4.0]), np.array([0.5, 0.3, -0.8])
FACING = np.diag([1.0, -1.0, -1.0])


def seen_at(point: Any, seconds: Any) -> Any:
    """Pixel of a point for a camera that has moved for so long."""
    rotation = FACING @ Rotation.from_rotvec(ANGULAR * seconds).as_matrix()
    position = POSITION + seconds * FACING @ LINEAR
    x, y, z = rotation.T @ (point - position)
    return np.array([400 * x / z + 319.5, 400 * y / z + 239.5])


def rolling(point: Any) -> Any:
    """Pixel of a point in a rolling-shutter image: tries every row."""
    rows = np.arange(480)
    pixels = np.array([seen_at(point, READOUT * row / 479) for row in rows])
    return pixels[np.argmin(np.abs(pixels[:, 1] - rows))]


def detections() -> Detections:
    quads = np.array([[rolling(corner) for corner in marker.corners] for marker in MAP.markers])
    true = np.ones((2, 4), bool)
    seen = MarkerQuads(MAP.markers[0].family, np.arange(2), quads, true, true[:, 0])
    pixels = quads.reshape(-1, 2)
    return Detections(np.arange(8), MAP.points, pixels, np.ones(8), (seen,), (), (), ())


def drawn(path: CameraPath) -> Any:
    """Where the picture, whose first row was exposed at 1 s, has the color of the cubes."""
    picture = np.full((480, 640, 3), 128, np.uint8)
    draw_world(picture, detections(), MAP, CAMERA, path, 10**9)
    return (picture[..., 0] > 160) & (picture[..., 1] < 80)


def near(mask: Any, pixel: Any) -> bool:
    x, y = np.rint(pixel).astype(int)
    return bool(mask[y - 1 : y + 2, x - 1 : x + 2].any())


def test_cubes_stand_on_their_markers_while_the_camera_moves():
    path = CameraPath(10**9, POSITION, FACING, LINEAR, ANGULAR)
    mask = drawn(path)
    for marker in MAP.markers:
        top = marker.corners + np.array([0.0, 0.0, marker.size])
        for corner in (*marker.corners, *top):
            assert near(mask, rolling(corner))
    # Between the corners, too; edges are not straight.
    for share in (0.25, 0.5, 0.75):
        a, b = MAP.markers[0].corners[1:3]
        assert near(mask, rolling(a + share * (b - a)))


def test_a_pose_of_another_instant_is_brought_to_each_row():
    # As with pose_time mid_frame: half a readout after the first row.
    later = 0.5 * READOUT
    rotation = FACING @ Rotation.from_rotvec(ANGULAR * later).as_matrix()
    position = POSITION + later * FACING @ LINEAR
    # The velocity is given in the axes of the camera, which has turned.
    linear = rotation.T @ FACING @ LINEAR
    path = CameraPath(10**9 + round(1e9 * later), position, rotation, linear, ANGULAR)
    mask = drawn(path)
    for marker in MAP.markers:
        assert all(near(mask, rolling(corner)) for corner in marker.corners)
