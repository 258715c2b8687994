# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Scenes: markers are where their map says, and most of a real motion sees them."""

import cv2
import numpy as np
import pytest

from rs_localizer import data
from rs_localizer.core.camera import Camera
from rs_localizer.io.trajectories import read_tum
from rs_localizer.simulation.renderer import Renderer
from rs_localizer.simulation.true_motion import (
    ConstantVelocity,
    RecordedMotion,
    TrueState,
    sampled_states,
)
from rs_localizer.simulation.walls import three_walls

CAMERA = Camera(640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]))
STILL = np.zeros(3)


@pytest.fixture(scope="module")
def way() -> TrueState:
    return sampled_states(RecordedMotion(read_tum(data.path(data.HAND_MOTION))), 0.5)


def pixels(corners: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    local = (corners.reshape(-1, 3) - position) @ rotation
    return CAMERA.project(local).reshape(-1, 4, 2)


@pytest.mark.parametrize("wall", [0, 1, 2])
def test_markers_are_where_the_map_says(way, wall):
    """OpenCV reads each of them, upright and unmirrored, at the corners of the map."""
    scene = three_walls(way)
    plane = scene.planes[wall]
    rotation = np.column_stack([plane.right, plane.down, plane.normal])
    middle = plane.corner + 0.5 * plane.size[0] * plane.right + 0.5 * plane.size[1] * plane.down
    position = middle - 3.0 * plane.normal
    pose = ConstantVelocity(STILL, STILL, 1.0, rotation=rotation, position=position)
    image = Renderer(CAMERA, scene.planes).image(pose, 0)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    found = detect(image, dictionary)
    by_id = {marker.id: marker.corners for marker in scene.marker_map.markers}
    assert len(found) >= 9
    for number, seen in found.items():
        expected = pixels(by_id[number], rotation, position)[0]
        # OpenCV's contours run along the middles of dark pixels.
        assert np.abs(seen - expected).max() < 1.0


def detect(image: np.ndarray, dictionary: object) -> dict[int, np.ndarray]:
    if hasattr(cv2.aruco, "ArucoDetector"):
        corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
    else:  # OpenCV 4.6
        corners, ids, _ = cv2.aruco.detectMarkers(image, dictionary)
    return {int(i): quad[0] for i, quad in zip(ids.ravel(), corners, strict=True)}
