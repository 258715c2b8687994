# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A room, a walk through it and what a rolling shutter sees of it, none of it the package's own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.independent import cameras
from benchmarks.independent.rotations import Array, exponential
from rs_localizer.core.camera import Camera
from rs_localizer.tools.mapping.observations import MapObservations, Start
from rs_localizer.tools.mapping.unknown_markers import Spotted

_HALF = 2.5  # m, of the room
SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
_STEEPEST = 0.35  # cosine of the angle at which markers are still seen
_LEAST_SIDE = 12.0  # px


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """A hand-held camera that goes round in the middle of the room and looks outward."""

    phases: Array  # (12,)
    turning: float  # rad/s
    wide: float = 1.2  # m
    sway: float = 0.0  # rad, how far it turns to and fro beside that

    def poses(self, times: Array) -> tuple[Array, Array]:
        """map_from_camera (n,3,3), (n,3) at times (n,), s; y of the map points down."""
        t, p = np.asarray(times, float), self.phases
        place = np.column_stack([
            self.wide * np.cos(0.4 * t + p[0]) + 0.03 * np.sin(5.0 * t + p[1]),
            0.2 * np.sin(0.6 * t + p[2]) + 0.02 * np.sin(7.0 * t + p[3]),
            self.wide * np.sin(0.5 * t + p[4]) + 0.03 * np.sin(6.0 * t + p[5]),
        ])  # fmt: skip
        about = np.zeros((3, len(t), 3))
        about[0, :, 1] = self.turning * t + 0.06 * np.sin(5.0 * t + p[6])
        about[0, :, 1] += self.sway * np.sin(0.8 * t + p[11])
        about[1, :, 0] = 0.25 * np.sin(0.7 * t + p[7]) + 0.05 * np.sin(8.0 * t + p[8])
        about[2, :, 2] = 0.1 * np.sin(0.9 * t + p[9]) + 0.04 * np.sin(6.0 * t + p[10])
        turn = exponential(about[0]) @ exponential(about[1]) @ exponential(about[2])
        return turn, place


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """A camera on what walks: ``X_camera = rotation (X_body - centre)``."""

    body: Walk
    rotation: Array  # (3,3)
    centre: Array  # (3,) m

    def poses(self, times: Array) -> tuple[Array, Array]:
        """map_from_camera, as of a walk."""
        turn, place = self.body.poses(times)
        return turn @ self.rotation.T, place + turn @ self.centre


def a_walk(rng: np.random.Generator, turning: float, wide: float = 1.2) -> Walk:
    """Any walk with this turn rate (rad/s)."""
    return Walk(rng.uniform(0.0, 2.0 * np.pi, 12), turning, wide)


def estimators_camera(camera: cameras.Camera, readout_time: float) -> Camera:
    """The same camera for the estimator."""
    return Camera(
        width=camera.width, height=camera.height, K=camera.matrix, D=np.array(camera.distortion),
        readout_time=readout_time, scan_direction=camera.scan,
    )  # fmt: skip


def walls(rng: np.random.Generator, count: int) -> Array:
    """Points (count,3) on the six sides of the room."""
    points = rng.uniform(-_HALF, _HALF, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = _HALF * rng.choice([-1.0, 1.0], count)
    return points


@dataclass(frozen=True, slots=True, eq=False)
class Film:
    """Images of a walk."""

    camera: cameras.Camera
    walk: Walk | Carried
    stamps: Array  # (g,) s, of the first rows

    def see(
        self, points: Array, noise: float, rng: np.random.Generator, most: int = 700
    ) -> MapObservations:
        """Keypoints of points (p,3), so many of an image at most."""
        images, landmarks, pixels = [], [], []
        for g, shown in enumerate(self._shown(points)):
            found = rng.permutation(np.flatnonzero(np.isfinite(shown[:, 0])))[:most]
            images.append(np.full(len(found), g))
            landmarks.append(found)
            pixels.append(shown[found] + rng.normal(0.0, noise, (len(found), 2)))
        return MapObservations(
            10**12 + np.round(1e9 * self.stamps).astype(np.int64),
            np.concatenate(images),
            np.concatenate(landmarks),
            np.concatenate(pixels),
        )

    def near(self, points: Array, off: float, rng: np.random.Generator) -> Start:
        """A first guess that is ``off`` (m) the truth."""
        rotations, places = self.walk.poses(self.stamps + 0.5 * self.camera.readout_time)
        return Start(
            points + rng.normal(0.0, off, points.shape),
            rotations @ exponential(rng.normal(0.0, 0.25 * off, (len(rotations), 3))),
            places + rng.normal(0.0, off, places.shape),
        )

    def spot(
        self, poses: list[tuple[Array, Array]], size: float, noise: float, rng: np.random.Generator
    ) -> list[Spotted]:
        """The markers that images show whole, large and not too slanted."""
        corners = np.concatenate([size * SQUARE @ turn.T + place for turn, place in poses])
        normals = np.array([turn[:, 2] for turn, _ in poses])
        middles = np.array([place for _, place in poses])
        spotted = []
        for stamp, pixels in zip(self.stamps.tolist(), self._shown(corners), strict=True):
            quads = pixels.reshape(-1, 4, 2)
            toward = self.walk.poses(np.array([stamp]))[1][0] - middles
            slant = np.einsum("ni,ni->n", toward, normals) / np.linalg.norm(toward, axis=1)
            side = np.linalg.norm(np.roll(quads, 1, axis=1) - quads, axis=2).min(axis=1)
            with np.errstate(invalid="ignore"):
                seen = np.flatnonzero((slant > _STEEPEST) & (side > _LEAST_SIDE))
            found = quads[seen] + rng.normal(0.0, noise, (len(seen), 4, 2))
            spotted.append(Spotted(10**12 + round(1e9 * stamp), seen, found))
        return spotted

    def _shown(self, points: Array) -> Iterator[Array]:
        """Pixels (p,2) of points in each image; NaN for those that it does not show."""
        size = np.array([self.camera.width, self.camera.height]) - 1.0
        for stamp in self.stamps.tolist():
            rotation, place = self.walk.poses(np.array([stamp]))
            local = (points - place) @ rotation[0]
            # What lies far outside is folded back by the lens's polynomial.
            ahead = np.flatnonzero(np.abs(local[:, :2]).max(axis=1) < local[:, 2])

            def local_at(delay: Array, stamp: float = stamp, those: Array = points[ahead]) -> Array:
                rotations, places = self.walk.poses(stamp + delay)
                return np.asarray(np.einsum("nji,nj->ni", rotations, those - places))

            pixels = self.camera.project_rolling(local_at, (len(ahead),))
            with np.errstate(invalid="ignore"):
                inside = np.all((pixels > 1.0) & (pixels < size - 1.0), axis=1)
            shown = np.full((len(points), 2), np.nan)
            shown[ahead[inside]] = pixels[inside]
            yield shown


def ring(rng: np.random.Generator, count: int) -> list[tuple[Array, Array]]:
    """Poses map_from_marker of markers all around the room, hung by hand."""
    poses = []
    for k in range(count):
        angle = 2.0 * np.pi * (k + rng.uniform(-0.2, 0.2)) / count
        outward = np.array([np.sin(angle), 0.0, np.cos(angle)])
        place = 2.2 * outward + [0.0, rng.uniform(-0.4, 0.4), 0.0]
        up = np.array([0.0, -1.0, 0.0])
        turn = np.column_stack([np.cross(up, -outward), up, -outward])
        poses.append((turn @ exponential(rng.normal(0.0, 0.15, (1, 3)))[0], place))
    return poses


def grid(columns: int, rows: int, size: float, gap: float) -> list[tuple[Array, Array]]:
    """Poses of a printed wall before the camera's place at rest."""
    facing = np.diag([1.0, -1.0, -1.0])
    pitch = size + gap
    return [
        (
            facing,
            np.array([
                (column - 0.5 * (columns - 1)) * pitch, (row - 0.5 * (rows - 1)) * pitch, 1.0,
            ]),
        )
        for row in range(rows)
        for column in range(columns)
    ]  # fmt: skip
