# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pictures to look at: what was seen, and a cube on each marker where the pose puts it.

Every point of a cube is drawn where the row that sees it, at its own time, has the camera: with a
right pose, twist and readout time the cubes stand on their markers, however fast the camera moves.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import project_rolling
from rs_localizer.markers.detection import Detections
from rs_localizer.markers.dictionaries import Gray
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.poses import Pose

Picture = NDArray[np.uint8]

# Blue, green, red. What is used is blue and whole, what is not is orange and crossed out: they
# differ by lightness and shape, too, for those who do not tell red from green.
_KNOWN, _FOREIGN, _CORNER, _CUBE = (230, 120, 0), (0, 150, 255), (0, 230, 255), (255, 0, 230)
_AXES = (("x", (60, 60, 255)), ("y", (60, 220, 60)), ("z", (255, 90, 60)))
_FIRST_RADIUS, _RADIUS = 4, 2
# Digits after the point of drawn coordinates, in bits.
_SHIFT = 4
# Points along an edge: its rows are seen at different times, so that it may be bent.
_EDGE_POINTS = 7
# Smaller markers (px) are too small for a cube.
_LEAST_SIDE = 15.0
# Farther outside than this, in sizes of the image, lens models mean nothing.
_FARTHEST = 1.0

_CUBE_EDGES = (
    *((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4)),
    *((0, 4), (1, 5), (2, 6), (3, 7)),
)


@dataclass(frozen=True, slots=True, eq=False)
class CameraPath:
    """A pose of the camera at an instant, and its velocities around it."""

    stamp_ns: int
    position: Array  # (3,) m, in the map
    rotation: Array  # (3,3) map_from_camera
    linear: Array  # (3,) m/s, camera axes; zero where unknown
    angular: Array  # (3,) rad/s, camera axes; zero where unknown

    def at(self, seconds: Array) -> tuple[Array, Array]:
        """Rotations (n,3,3) and translations (n,3) camera_from_map, this long after the instant."""
        turns = self.rotation @ so3.exp_many(seconds[:, None] * self.angular)
        places = self.position + seconds[:, None] * (self.rotation @ self.linear)
        back = np.swapaxes(turns, 1, 2)
        return back, -np.einsum("nij,nj->ni", back, places)


def draw_detections(image: Gray, detections: Detections) -> Picture:
    """The image with outlines: blue what is used, orange and crossed what is not."""
    picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    for item in detections.markers:
        for quad, id_, mapped in zip(item.quads, item.ids.tolist(), item.mapped, strict=True):
            color = _KNOWN if mapped else _FOREIGN
            _line(picture, np.vstack([quad, quad[:1]]), color, 2 if mapped else 1)
            if not mapped:
                _line(picture, quad[[0, 2]], color)
                _line(picture, quad[[1, 3]], color)
            _text(picture, str(id_), quad.mean(axis=0), color)
    for pixel, id_ in zip(detections.pixels, detections.ids.tolist(), strict=True):
        _dot(picture, pixel, _FIRST_RADIUS if id_ % 4 == 0 else _RADIUS)
    return picture


def draw_world(
    picture: Picture,
    detections: Detections,
    marker_map: MarkerMap,
    camera: Camera,
    path: CameraPath,
    first_row_ns: int,
) -> None:
    """Add the axes of the map and a cube on each print that is seen.

    Args:
        picture: is drawn into.
        detections: what the image shows.
        marker_map: where the prints are.
        camera: with its readout time.
        path: of the camera.
        first_row_ns: when the first row was exposed.
    """
    before = (first_row_ns - path.stamp_ns) * 1e-9
    first = camera.first_row_time

    def poses_at(tau: Array) -> tuple[Array, Array]:
        return path.at(before + camera.readout_time * (tau - first))

    standing = list(_standing(detections, marker_map))
    length = max((size for _, size in standing), default=0.0)
    lines = [(line, "", _CUBE) for pose, size in standing for line in _cube(pose, size)]
    lines += [
        (_edge(np.zeros(3), length * axis), name, color)
        for axis, (name, color) in zip(np.eye(3), _AXES, strict=True)
    ]
    pixels, _ = project_rolling(camera, poses_at, np.concatenate([line for line, *_ in lines]))
    width, height = camera.size
    middle, reach = 0.5 * np.array([width, height]), (0.5 + _FARTHEST) * max(width, height)
    for (_, name, color), seen in zip(lines, pixels.reshape(-1, _EDGE_POINTS, 2), strict=True):
        if np.abs(seen - middle).max() < reach:  # NaN is not
            _line(picture, seen, color)
            if name:
                _text(picture, name, seen[-1], color)


def _standing(detections: Detections, marker_map: MarkerMap) -> Iterator[tuple[Pose, float]]:
    """Poses and sizes of the prints that are seen large enough."""
    shown = {
        (item.family.kind, id_)
        for item in detections.markers
        for id_, quad, mapped in zip(item.ids.tolist(), item.quads, item.mapped, strict=True)
        if mapped and np.linalg.norm(np.ptp(quad, axis=0)) > _LEAST_SIDE
    }
    for marker in marker_map.markers:
        if (marker.family.kind, marker.id) in shown:
            yield marker.pose, marker.size
    names = {name for name, _ in detections.boards}
    for board in marker_map.boards:
        if board.name in names:
            yield board.pose, min(board.extent)


def _cube(pose: Pose, size: float) -> list[Array]:
    """Edges of a cube that stands on a print."""
    x = 0.5 * size
    base = np.array([[-x, x, 0], [x, x, 0], [x, -x, 0], [-x, -x, 0]])
    corners = pose(np.vstack([base, base + np.array([0.0, 0.0, size])]))
    return [_edge(corners[a], corners[b]) for a, b in _CUBE_EDGES]


def _edge(a: Array, b: Array) -> Array:
    share = np.linspace(0.0, 1.0, _EDGE_POINTS)[:, None]
    return np.asarray(a + share * (b - a))


def _text(picture: Picture, text: str, pixel: Array, color: tuple[int, int, int]) -> None:
    """A word that can be read on black and on white."""
    place = tuple(np.rint(pixel).astype(int).tolist())
    for shade, width in (((0, 0, 0), 3), (color, 1)):
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, shade, width, cv2.LINE_AA)


def _line(picture: Picture, pixels: Array, color: tuple[int, int, int], width: int = 1) -> None:
    fixed = np.rint(pixels * 2**_SHIFT).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(picture, [fixed], False, color, width, cv2.LINE_AA, _SHIFT)


def _dot(picture: Picture, pixel: Array, radius: int) -> None:
    x, y = np.rint(pixel * 2**_SHIFT).astype(int).tolist()
    cv2.circle(picture, (x, y), radius << _SHIFT, _CORNER, 1, cv2.LINE_AA, _SHIFT)
