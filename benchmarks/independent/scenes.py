# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What the cameras see: points all around, walls, small planes, boards and markers."""

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.independent.cameras import Camera
from benchmarks.independent.motions import IntArray, Moving, directions
from benchmarks.independent.rotations import Array, BoolArray, exponential

_DEPTHS = (1.0, 5.0)  # m
_WALL_DISTANCE, _WALL_TILT = 2.5, math.radians(20.0)
_MARGIN = 12.0  # px that noise may not carry a point over


@dataclass(frozen=True, slots=True)
class Rich:
    """Points at all depths, other ones in every frame."""

    points: int = 80


@dataclass(frozen=True, slots=True)
class Wall:
    """Points on a wall that fills the image, other ones in every frame."""

    points: int = 80


@dataclass(frozen=True, slots=True)
class SmallPlane:
    """A square of points at random places, in the middle of the image."""

    size: float = 0.6  # m
    distance: float = 2.5
    tilt: float = 30.0  # deg between its normal and the way to the camera
    points: int = 50


@dataclass(frozen=True, slots=True)
class Board:
    """A chessboard of 9 x 6 inner corners, or three markers in a row; 0.5 m wide.

    ``bend``: how far (m) its middle stands off the plane through its sides, of which the map
    knows nothing.
    """

    markers: bool = False
    bend: float = 0.0
    distance: float = 1.0
    tilt: float = 25.0  # deg


Scene = Rich | Wall | SmallPlane | Board


def points(
    scene: Scene, camera: Camera, motions: Moving, which: IntArray, middle: Array,
    rng: np.random.Generator,
) -> tuple[Array, Array]:  # fmt: skip
    """Points (f,n,3) of each frame: as they are, and as the map has them.

    ``which`` (f,) tells the motion of each frame, ``middle`` (f,) the time of its middle row.
    """
    if isinstance(scene, Rich | Wall):
        seen = _in_view(scene, camera, motions, which, middle, rng)
        return seen, seen
    flat, bend = _pattern(scene, len(motions), rng)
    centre, axes = _placed(scene, motions, rng)
    mapped = centre[:, None] + flat @ np.swapaxes(axes, 1, 2)
    half = np.abs(flat[..., 0]).max()
    off = bend * (1.0 - (flat[..., 0] / half) ** 2)
    true = mapped + off[..., None] * axes[:, None, :, 2]
    return true[which], mapped[which]


def _in_view(
    scene: Rich | Wall, camera: Camera, motions: Moving, which: IntArray, middle: Array,
    rng: np.random.Generator,
) -> Array:  # fmt: skip
    """Points behind random pixels of the middle row's instant."""
    shape = (len(which), scene.points)
    size = np.array([camera.width, camera.height]) - 1.0
    pixels = rng.uniform(_MARGIN, size - _MARGIN, (*shape, 2))
    rays = np.concatenate([camera.bearings(pixels), np.ones((*shape, 1))], axis=-1)
    rotation, position = motions.poses(which, middle)
    in_map = rays @ np.swapaxes(rotation, 1, 2)
    if isinstance(scene, Rich):
        depth = rng.uniform(*_DEPTHS, shape)
    else:
        centre, axes = _placed(scene, motions, rng)
        normal = axes[which, :, 2]
        height = np.einsum("fi,fi->f", normal, centre[which] - position)
        # Where a ray passes the wall by, the point lies behind the camera and is not seen.
        depth = height[:, None] / np.einsum("fi,fni->fn", normal, in_map)
    return np.asarray(position[:, None] + depth[..., None] * in_map)


def _pattern(
    scene: SmallPlane | Board, count: int, rng: np.random.Generator
) -> tuple[Array, float]:
    """Flat points (count,n,3) around the middle, and their bend."""
    if isinstance(scene, SmallPlane):
        places = scene.size * rng.uniform(-0.5, 0.5, (count, scene.points, 2))
        return np.concatenate([places, np.zeros((*places.shape[:2], 1))], axis=-1), 0.0
    if scene.markers:
        corners = 0.06 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        grid = np.concatenate([corners + np.array([x, 0.0]) for x in (-0.19, 0.0, 0.19)])
    else:
        columns, rows = np.meshgrid(np.linspace(-0.25, 0.25, 9), np.linspace(-0.156, 0.156, 6))
        grid = np.column_stack([columns.ravel(), rows.ravel()])
    flat = np.column_stack([grid, np.zeros(len(grid))])
    return np.broadcast_to(flat, (count, *flat.shape)), scene.bend


def _placed(
    scene: Wall | SmallPlane | Board, motions: Moving, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Middles (m,3) and axes (m,3,3) of planes before the cameras at time 0; the normal is z."""
    count = len(motions)
    distance = _WALL_DISTANCE if isinstance(scene, Wall) else scene.distance
    tilt = _WALL_TILT if isinstance(scene, Wall) else math.radians(scene.tilt)
    tilts = np.full((count, 1), tilt)
    if not isinstance(scene, SmallPlane):
        tilts = rng.uniform(0.0, tilt, (count, 1))
    around = rng.uniform(0.0, 2.0 * np.pi, count)
    axis = np.column_stack([np.cos(around), np.sin(around), np.zeros(count)])
    spin = np.zeros((count, 3))
    spin[:, 2] = rng.normal(0.0, 0.2, count)
    axes = motions.rotation @ exponential(tilts * axis) @ exponential(spin)
    aside = 0.05 * distance * directions(count, rng)
    centre = np.array([0.0, 0.0, distance]) + aside
    return motions.position + np.einsum("mij,mj->mi", motions.rotation, centre), axes


def visible(camera: Camera, pixels: Array) -> BoolArray:
    """Which pixels (...,2) lie in the image, and stay there under noise."""
    size = np.array([camera.width, camera.height]) - 1.0
    return np.asarray(np.all((pixels >= _MARGIN) & (pixels <= size - _MARGIN), axis=-1))
