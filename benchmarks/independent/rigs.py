# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Cameras that are mounted to one moving body, each with a shutter and a clock of its own."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from benchmarks.independent.cameras import Camera
from benchmarks.independent.motions import IntArray, Moving
from benchmarks.independent.rotations import Array, BoolArray, exponential
from benchmarks.independent.scenes import visible

_DEPTHS = (1.5, 5.0)  # m
_WALL_DISTANCE, _TILT = 2.5, math.radians(20.0)
_MARGIN = 12.0  # px


class Scene(StrEnum):
    """What a rig sees."""

    RICH = "rich"  # points 1.5 to 5 m before each camera
    WALL = "wall"  # 2.5 m before the body, tilted


@dataclass(frozen=True, slots=True, eq=False)
class Mounted:
    """A camera on a body: ``X_camera = rotation X_body + translation``."""

    camera: Camera
    rotation: Array  # (3,3)
    translation: Array  # (3,) m
    start: float = 0.0  # s after the frame's beginning that its first row is exposed

    def seen(self, motions: Moving, which: IntArray, begin: Array, points: Array) -> Array:
        """Pixels (f,n,2) of points (f,n,3) in frames that begin at these times (f,)."""
        each, shape = np.repeat(which, points.shape[1]), points.shape[:2]

        def local_at(delay: Array) -> Array:
            now = (begin + self.start)[:, None] + delay
            rotation, position = motions.poses(each, now.ravel())
            body = np.einsum("nji,nj->ni", rotation, points.reshape(-1, 3) - position)
            local: Array = body @ self.rotation.T + self.translation
            return local.reshape(points.shape)

        return self.camera.project_rolling(local_at, shape)


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """What one camera sees in f frames of n points."""

    points: Array  # (f,n,3)
    exact: Array  # (f,n,2)
    visible: BoolArray  # (f,n)
    last_pixel: Array  # (2,)


def noisy_frames(
    seen: Mapping[str, Views], noise: float, outliers: float, rng: np.random.Generator
) -> Iterator[dict[str, tuple[Array, Array]]]:
    """Yield what each frame shows: points (n,3) and pixels (n,2) of each camera.

    Args:
        noise: px.
        outliers: share of the points that are shown anywhere.
    """
    for frame in range(len(next(iter(seen.values())).points)):
        parts = {}
        for name, view in seen.items():
            shown = view.visible[frame]
            pixels = view.exact[frame, shown]
            pixels = pixels + noise * rng.normal(size=pixels.shape)
            wrong = rng.uniform(size=len(pixels)) < outliers
            pixels[wrong] = rng.uniform(0.0, view.last_pixel, (wrong.sum(), 2))
            parts[name] = view.points[frame, shown], pixels
        yield parts


def middle_of(rig: Mapping[str, Mounted]) -> float:
    """Middle of all exposures, s after a frame's beginning."""
    ends = [mounted.start + mounted.camera.readout_time for mounted in rig.values()]
    return 0.5 * (min(mounted.start for mounted in rig.values()) + max(ends))


def views(
    rig: Mapping[str, Mounted], motions: Moving, begin: Array, count: int, scene: Scene,
    rng: np.random.Generator, wider: float = 0.0,
) -> dict[str, Views]:  # fmt: skip
    """So many points before each camera, other ones for each.

    Args:
        wider: parts of the image by which they lie outside it, too.
        begin: (f,) time of each motion at which its frame begins.
    """
    which = np.arange(len(begin))
    axis = np.column_stack([rng.normal(size=(len(begin), 2)), np.zeros(len(begin))])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    tilt = exponential(rng.uniform(0.0, _TILT, (len(begin), 1)) * axis)
    rotation, position = motions.poses(which, begin + middle_of(rig))
    result = {}
    for name, mounted in rig.items():
        size = np.array([mounted.camera.width, mounted.camera.height]) - 1.0
        beside = _MARGIN - wider * size
        pixels = rng.uniform(beside, size - beside, (len(begin), count, 2))
        ones = np.ones((*pixels.shape[:2], 1))
        rays = np.concatenate([mounted.camera.bearings(pixels), ones], axis=-1) @ mounted.rotation
        centre = -mounted.rotation.T @ mounted.translation
        if scene is Scene.WALL:
            depth = (_WALL_DISTANCE - tilt[:, :, 2] @ centre)[:, None]
            depth = depth / np.einsum("fi,fni->fn", tilt[:, :, 2], rays)
        else:
            depth = rng.uniform(*_DEPTHS, pixels.shape[:2])
        body = centre + depth[..., None] * rays
        points = position[:, None] + np.einsum("fij,fnj->fni", rotation, body)
        exact = mounted.seen(motions, which, begin, points)
        result[name] = Views(points, exact, visible(mounted.camera, exact), size)
    return result
