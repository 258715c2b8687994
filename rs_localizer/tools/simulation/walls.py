# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Scenes of textured planes around the path of a simulated camera, built to be looked at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.io.video import Image
from rs_localizer.markers.dictionaries import pattern
from rs_localizer.markers.families import family
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.markers.prints import Marker, Pose

if TYPE_CHECKING:
    from rs_localizer.tools.simulation.true_motion import TrueState


@dataclass(frozen=True, slots=True, eq=False)
class TexturedPlane:
    """A rectangle with a grey picture on both of its sides.

    Texel (row i, column j) covers the square from ``j`` to ``j + 1`` texels along ``right`` and
    from ``i`` to ``i + 1`` along ``down``, counted from ``corner``.
    """

    corner: Array  # (3,) m, map frame: where the picture's first texel begins
    right: Array  # (3,) unit vector along the picture's rows
    down: Array  # (3,) unit vector along its columns
    texel: float  # m
    texture: Image  # (height, width)

    @property
    def normal(self) -> Array:
        """(3,) unit vector, away from a viewer who reads the picture unmirrored."""
        return np.cross(self.right, self.down)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, m."""
        height, width = self.texture.shape
        return width * self.texel, height * self.texel

    def points(self, texels: Array) -> Array:
        """Return points (n,3) of the map at texel coordinates (n,2), counted from the corner."""
        across, along = self.texel * np.asarray(texels, float).T
        return np.asarray(self.corner + across[:, None] * self.right + along[:, None] * self.down)

    def homographies(self, rotations: Array, positions: Array) -> Array:
        """Return homographies (n,3,3) from bearings to texels, for n cameras.

        The third coordinate of ``H (a, b, 1)`` is the inverse depth of the plane along that
        bearing, negative behind the camera; the first two over it are the texel coordinates.

        Args:
            rotations: (n,3,3) map_from_camera.
            positions: (n,3) camera centres.
        """
        normal = self.normal
        from_corner = positions - self.corner
        # Along the bearing d the plane is met at c + d / q with q = -n d / n (c - corner).
        distance = from_corner @ normal
        with np.errstate(divide="ignore", invalid="ignore"):  # a camera in the plane sees no plane
            inverse_depth = -(normal @ rotations) / distance[:, None]
        rows = [
            (axis @ rotations + (from_corner @ axis)[:, None] * inverse_depth) / self.texel
            for axis in (self.right, self.down)
        ]
        return np.stack([*rows, inverse_depth], axis=1)


# Shapes per square of this many texels, of all sizes between a few texels and a few hundred.
_SHAPES_PER = 9000
_SMALLEST, _LARGEST = 6.0, 400.0
# Fine grain (standard deviation of a grey level) and its sizes in texels.
_GRAIN = ((1, 6.0), (4, 8.0), (32, 10.0))


def collage(width: int, height: int, rng: np.random.Generator) -> Image:
    """Draw rectangles, discs and letters of all sizes and greys, with some grain.

    The same generator state gives the same picture (height, width).
    """
    picture = np.full((height, width), 128, np.uint8)
    count = max(20, width * height // _SHAPES_PER)
    # Large ones first, or they would cover the rest.
    sizes = np.sort(np.exp(rng.uniform(np.log(_SMALLEST), np.log(_LARGEST), count)))[::-1]
    for size in sizes.tolist():
        middle = rng.uniform((0.0, 0.0), (width, height))
        _draw_shape(picture, middle.tolist(), size, int(rng.integers(10, 246)), rng)
    grey = picture.astype(np.float32)
    for step, deviation in _GRAIN:
        grain = rng.standard_normal((height // step + 2, width // step + 2)).astype(np.float32)
        grown = cv2.resize(grain, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)
        grey += deviation * grown[:height, :width]
    return np.clip(np.rint(grey), 0.0, 255.0).astype(np.uint8)


def _draw_shape(
    picture: Image, middle: list[float], size: float, grey: int, rng: np.random.Generator
) -> None:
    x, y = (int(value) for value in middle)
    kind, angle = rng.integers(3), float(rng.uniform(0.0, 180.0))
    if kind == 0:
        extent = (size, size * float(rng.uniform(0.2, 1.0)))
        box = cv2.boxPoints(((x, y), extent, angle))
        cv2.fillPoly(picture, [np.rint(box).astype(np.int32)], grey, cv2.LINE_AA)
    elif kind == 1:
        axes = (max(1, int(0.5 * size)), max(1, int(0.5 * size * rng.uniform(0.4, 1.0))))
        cv2.ellipse(picture, (x, y), axes, angle, 0.0, 360.0, grey, -1, cv2.LINE_AA)
    else:
        letter = chr(int(rng.integers(ord("A"), ord("Z") + 1)))
        cv2.putText(
            picture, letter, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size / 22.0, grey,
            max(1, int(size / 9.0)), cv2.LINE_AA,
        )  # fmt: skip


_FAMILY = "4x4_250"  # few cells: the largest that a far or slanted marker can show
# Texels along a cell of a marker: corners lie between texels, so that nothing is rounded.
_CELL_TEXELS = 24
# Sides of the markers (m) on the walls and, seen at a slant, on the floor; gaps in sides.
_WALL_MARKER, _FLOOR_MARKER, _GAP = 0.42, 0.56, 0.5
# Distances (m) from the path of the camera to the two walls, to their ends, to the floor and to the
# top. In a larger room all markers would be too small to read; a smaller one would show too few.
_NEAR, _OPEN, _BELOW, _ABOVE = 1.5, 3.1, 0.9, 1.8
# Each plane has its own light, so that edges can be seen: grey of its paper and its ink.
_LIGHTS = ((235, 26), (200, 22), (172, 18))
# Texel (m) of pictures that are no markers.
_PICTURE_TEXEL = 0.003


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Things that a rendered camera looks at."""

    planes: tuple[TexturedPlane, ...]
    marker_map: MarkerMap | None = None  # None: a scene without markers


def three_walls(path: TrueState) -> Scene:
    """Return two walls and a floor full of markers, in a corner before the camera.

    The corner stands where the camera looks on average.

    Args:
        path: of the camera, evenly in time, in a map whose z points up.
    """
    axes, low, high = _box(path, turned=0.25 * np.pi)
    corner = np.array([*(high[:2] + _NEAR), low[2] - _BELOW])
    extent = corner - (low - _OPEN)
    height = high[2] + _ABOVE - corner[2]
    # Larger markers where a long path would need more than there are.
    scale, most = 1.0, family(_FAMILY).count
    while True:
        pitches = scale * (1.0 + _GAP) * np.array([_WALL_MARKER, _FLOOR_MARKER])
        x, y, z = (max(1, round(length / pitches[0])) for length in (*extent[:2], height))
        floor = [max(1, round(length / pitches[1])) for length in extent[:2]]
        if (x + y) * z + floor[0] * floor[1] <= most:
            break
        scale *= 1.1
    ex, ey, ez = np.eye(3)
    # Each wall: number of markers, their side, its right and up as a viewer has them, its middle.
    spans = pitches[0] * np.array([x, y, z])
    ground = pitches[1] * np.array(floor)
    walls = (
        (y, z, _WALL_MARKER, -ey, ez, corner - 0.5 * spans[1] * ey + 0.5 * spans[2] * ez),
        (x, z, _WALL_MARKER, ex, ez, corner - 0.5 * spans[0] * ex + 0.5 * spans[2] * ez),
        (*floor, _FLOOR_MARKER, ex, ey, corner - 0.5 * ground[0] * ex - 0.5 * ground[1] * ey),
    )
    markers: list[Marker] = []
    planes = []
    for (columns, rows, side, right, up, middle), light in zip(walls, _LIGHTS, strict=True):
        frame = axes @ np.column_stack([right, up, np.cross(right, up)])
        pose = Pose(axes @ middle, frame)
        size, first_id = scale * side, len(markers)
        planes.append(_marker_plane(pose, columns, rows, size, first_id, light))
        markers += wall(_FAMILY, (columns, rows), size, _GAP * size, first_id=first_id, pose=pose)
    return Scene(tuple(planes), MarkerMap(tuple(markers)))


def room(path: TrueState) -> Scene:
    """Return a closed room around the path of the camera, every wall with its own picture."""
    axes, low, high = _box(path, turned=0.0)
    low, high = low - _NEAR, high + _NEAR
    planes = []
    for axis in range(3):
        across, along = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        size = np.array([(high - low) @ across, (high - low) @ along])
        for side in range(2):
            start = low.copy()
            start[axis] = (low, high)[side][axis]
            planes.append(_picture(axes, start, across, along, size, 2 * axis + side))
    return Scene(tuple(planes))


def _box(path: TrueState, turned: float) -> tuple[Array, Array, Array]:
    """Return axes (3,3), low and high (3,) of the path, of its mean horizontal gaze.

    The axes, map_from_box, are turned about z from the gaze; z is up.
    """
    gaze = path.rotations[:, :2, 2].mean(axis=0)
    angle = float(np.arctan2(gaze[1], gaze[0])) - turned
    cosine, sine = np.cos(angle), np.sin(angle)
    axes = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    seen_from = path.positions @ axes
    return axes, seen_from.min(axis=0), seen_from.max(axis=0)


def _marker_plane(
    pose: Pose, columns: int, rows: int, size: float, first_id: int, light: tuple[int, int]
) -> TexturedPlane:
    """Return the paper of a grid of markers with half a gap around it."""
    drawn = family(_FAMILY)
    side = drawn.cells * _CELL_TEXELS
    pitch = round((1.0 + _GAP) * side)
    margin = (pitch - side) // 2
    texture = np.full((rows * pitch, columns * pitch), light[0], np.uint8)
    for index in range(columns * rows):
        row, column = (margin + pitch * place for place in divmod(index, columns))
        cells = printed(pattern(drawn, first_id + index), light, _CELL_TEXELS)
        texture[row : row + side, column : column + side] = cells
    texel = size / side
    right, up, _ = pose.rotation.T
    corner = pose.position + 0.5 * texel * pitch * (rows * up - columns * right)
    return TexturedPlane(corner, right, -up, texel, texture)


def printed(white: NDArray[np.bool_], light: tuple[int, int], texels: int) -> Image:
    """Return the cells of a marker, each this many texels wide, in greys of paper and ink."""
    cells = np.where(white, *light).astype(np.uint8)
    return cells.repeat(texels, axis=0).repeat(texels, axis=1)


def _picture(
    axes: Array, corner: Array, right: Array, down: Array, size: Array, seed: int
) -> TexturedPlane:
    width, height = (max(2, round(length / _PICTURE_TEXEL)) for length in size)
    texture = collage(width, height, np.random.default_rng(seed))
    return TexturedPlane(axes @ corner, axes @ right, axes @ down, _PICTURE_TEXEL, texture)


SCENES = {"three": three_walls, "room": room}
"""All scenes by name, the first one unless another is wanted."""
