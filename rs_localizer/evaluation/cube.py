"""A cube in the scene, drawn into the images: the eye sees an error of the pose at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import project_rolling
from rs_localizer.io.video import Image
from rs_localizer.markers.prints import Marker

# Of a marker's side: the cube stands on the paper around it.
_SIDE = 1.5
# Points along an edge: the shutter bends it.
_POINTS = 24
# Binary digits of a pixel that OpenCV's drawing takes.
_SHIFT = 4
_OPACITY = 0.35
_WIDTH = 3

# Corner k is at the digits of k: x, y, z; the cube's frame is that of the marker below it.
_CORNERS = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)]) - np.array([0.5, 0.5, 0.0])
# Corners of each face around it, anticlockwise from outside.
_FACES = np.array(
    [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
)

PosesAt = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True, slots=True, eq=False)
class Cube:
    """A cube by its corners (8,3), m in the map frame."""

    corners: Array


def cube_on(marker: Marker) -> Cube:
    """A cube that stands on a marker like a box on a carpet."""
    return Cube(marker.pose(_SIDE * marker.size * _CORNERS))


def corner_pixels(camera: Camera, poses_at: PosesAt, cube: Cube) -> Array:
    """Raw pixels (8,2) where a moving camera sees the corners; NaN where it does not."""
    return project_rolling(camera, poses_at, cube.corners)[0]


def draw_cube(
    picture: Image, camera: Camera, poses_at: PosesAt, cube: Cube, color: tuple[int, int, int]
) -> None:
    """Draw a cube into a picture (height, width, 3), each of its points at its own row's pose.

    Args:
        poses_at: row times (n,) to poses camera_from_map, as of ``Motion.at_rows``.
    """
    rotations, translations = poses_at(np.zeros(1))
    centre = -rotations[0].T @ translations[0]
    outlines = [_outline(camera, poses_at, cube.corners[face]) for face in _FACES]
    if not all(np.all(np.isfinite(outline)) for outline in outlines):
        return  # partly behind the camera
    near = [_faces_viewer(cube.corners[face], centre) for face in _FACES]
    fixed = [np.rint(outline * 2**_SHIFT).astype(np.int32) for outline in outlines]
    for outline, seen in zip(fixed, near, strict=True):
        if not seen:
            cv2.polylines(picture, [outline], True, color, 1, cv2.LINE_AA, _SHIFT)
    filled = picture.copy()
    for outline, seen in zip(fixed, near, strict=True):
        if seen:
            cv2.fillPoly(filled, [outline], color, cv2.LINE_AA, _SHIFT)
    cv2.addWeighted(filled, _OPACITY, picture, 1.0 - _OPACITY, 0.0, dst=picture)
    for outline, seen in zip(fixed, near, strict=True):
        if seen:
            cv2.polylines(picture, [outline], True, color, _WIDTH, cv2.LINE_AA, _SHIFT)


def _outline(camera: Camera, poses_at: PosesAt, face: Array) -> Array:
    """Raw pixels (n,2) of points all around a face (4,3)."""
    share = np.arange(_POINTS)[:, None] / _POINTS
    edges = [a + share * (b - a) for a, b in zip(face, np.roll(face, -1, axis=0), strict=True)]
    return project_rolling(camera, poses_at, np.concatenate(edges))[0]


def _faces_viewer(face: Array, centre: Array) -> bool:
    normal = np.cross(face[1] - face[0], face[2] - face[1])
    return bool(normal @ (centre - face[0]) > 0.0)
