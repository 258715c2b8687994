# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A model of COLMAP as a global shutter would have given it, for programs that know no other one.

Motion and the most useful points are adjusted with the rolling shutter, all points are triangulated
with that motion, and each keypoint is moved to where a camera at the pose of one row of its image
has the same point: along its own ray, to the depth of the point. The noise of a keypoint stays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.rectification import transferred
from rs_localizer.io.maps.colmap import Model, ModelImage, Points
from rs_localizer.tools.adjust.problem import LIMIT
from rs_localizer.tools.mapping import MappingError
from rs_localizer.tools.mapping.build import USUAL_DISTANCE, Motion
from rs_localizer.tools.mapping.colmap import HALF, Effort
from rs_localizer.tools.mapping.observations import (
    LEAST_KEYPOINTS,
    MapObservations,
    Start,
    most_observed,
)
from rs_localizer.tools.mapping.refine import RefinedMap, refine
from rs_localizer.tools.mapping.shutter_fit import (
    colmap_freedom,
    fit_shutter,
    likely_axes,
)
from rs_localizer.tools.mapping.triangulation import triangulate
from rs_localizer.tools.readout_belief import ShutterFit


@dataclass(frozen=True, slots=True)
class Shutter:
    """What is known of the camera's shutter, and what is wanted."""

    readout_time: float | None = None  # s; None: estimated
    scan_direction: str | None = None  # None: unknown
    lens: bool = False  # whether the lens is adjusted
    tau: float = 0.0  # row time of the global shutter: 0 the middle row, -0.5 first, 0.5 last


@dataclass(frozen=True, slots=True, eq=False)
class GlobalShutterModel:
    """The model, and how it came about."""

    camera: Camera  # with its lens and shutter as they were found
    images: dict[str, ModelImage]  # with the keypoints that fit
    points: Points
    refined: RefinedMap
    shutter: ShutterFit | None  # None: it was given, or too few images follow each other
    keypoints: int  # of points, that the model had
    before: float  # px rms, of the keypoints that are kept, in the model as it was
    after: float  # px rms, of the same in this one


def undo_shutter(
    camera: Camera,
    model: Model,
    images: Mapping[str, ModelImage],
    stamps_ns: Mapping[str, int],
    known: Shutter,
    done: Callable[[str], object] = lambda text: None,
) -> GlobalShutterModel:
    """The model that a global shutter would have given.

    Args:
        camera: of all images; its shutter does not matter.
        model: points and who sees them.
        images: by their names.
        stamps_ns: of the images, by their names; no two are the same.
        known: of the shutter.
        done: called with each part of the work that is done.

    Raises:
        ValueError: when the images do not determine it, saying what was found.
    """
    names = sorted(images, key=lambda name: stamps_ns[name])
    stamps = np.array([stamps_ns[name] for name in names], np.int64)
    given = _Given.of(camera, model, [images[name] for name in names])
    refined, shutter, used = _refined(given, camera, stamps, known, done)
    motion = Motion(used, refined.times, refined)
    projected = motion.sights(given.images, given.rows, given.pixels)
    posed = np.isin(given.images, used)
    at, rows, pixels = given.images[posed], given.rows[posed], given.pixels[posed]
    points = triangulate(refined.camera, projected, len(given.points)).points
    rotations = np.swapaxes(projected.rotations, 1, 2)
    own = rotations, -np.einsum("nij,nj->ni", rotations, projected.positions)
    in_camera = _moved(own, points[rows])
    errors = np.sum((refined.camera.project(in_camera) - pixels) ** 2, axis=1)
    fits: BoolArray = (errors < (LIMIT * refined.deviation) ** 2) & (in_camera[:, 2] > 0.0)
    fits &= (np.bincount(rows[fits], minlength=len(points)) > 1)[rows]
    at, rows, pixels = at[fits], rows[fits], pixels[fits]
    states = refined.spline.states(refined.times + abs(refined.readout_time) * known.tau)
    turns = np.swapaxes(states.rotations, 1, 2)
    views = turns, -np.einsum("nij,nj->ni", turns, states.positions)
    place = np.searchsorted(used, at)
    of_each = views[0][place], views[1][place]
    own = own[0][fits], own[1][fits]
    moved = transferred(refined.camera, pixels, own, of_each, in_camera[fits, 2])
    apart = np.linalg.norm(refined.camera.project(_moved(of_each, points[rows])) - moved, axis=1)
    before = np.linalg.norm(given.errors(camera)[posed][fits], axis=1)
    made = {}
    for k, row in enumerate(used.tolist()):
        mine = at == row
        made[names[row]] = replace(
            images[names[row]],
            rotation=views[0][k],
            translation=views[1][k] / given.scale,
            pixels=moved[mine] + HALF,
            points=model.ids[rows[mine]],
        )
    shown = np.unique(rows)
    counts = np.bincount(rows, minlength=len(points))
    means = np.bincount(rows, apart, len(points)) / np.maximum(counts, 1)
    return GlobalShutterModel(
        camera=refined.camera_as_found,
        images=made,
        points=Points(
            model.ids[shown], points[shown] / given.scale, model.colors[shown], means[shown]
        ),
        refined=refined,
        shutter=shutter,
        keypoints=len(given.rows),
        before=float(np.sqrt(np.mean(before**2))),
        after=float(np.sqrt(np.mean(apart**2))),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Given:
    """A model as arrays, of about the size of a room: priors of motions are in metres."""

    scale: float
    points: Array  # (p,3)
    rotations: Array  # (g,3,3) world_from_camera
    positions: Array  # (g,3)
    images: IntArray  # (n,) of each keypoint
    rows: IntArray  # (n,) of the points
    pixels: Array  # (n,2) raw

    @staticmethod
    def of(camera: Camera, model: Model, images: list[ModelImage]) -> _Given:
        """Raises MappingError for keypoints of points that are not there."""
        shown = [image.points >= 0 for image in images]
        counts = [int(np.count_nonzero(some)) for some in shown]
        ids = np.concatenate(
            [image.points[some] for image, some in zip(images, shown, strict=True)]
        )
        order = np.argsort(model.ids)
        places = np.searchsorted(model.ids[order], ids)
        rows = order[np.minimum(places, len(order) - 1)] if len(order) else np.zeros_like(ids)
        if not len(ids) or np.any(model.ids[rows] != ids):
            raise MappingError("the model's images list no keypoints of its points")
        pixels = np.concatenate(
            [image.pixels[some] for image, some in zip(images, shown, strict=True)]
        )
        rotations = np.array([image.rotation.T for image in images])
        translations = np.array([image.translation for image in images])
        positions = -np.einsum("gij,gj->gi", rotations, translations)
        at = np.repeat(np.arange(len(images)), counts)
        depths = np.linalg.norm(model.points[rows] - positions[at], axis=1)
        scale = USUAL_DISTANCE / float(np.median(depths))
        return _Given(
            scale, scale * model.points, rotations, scale * positions, at, rows, pixels - HALF
        )

    def errors(self, camera: Camera) -> Array:
        """What the model leaves (n,2), px, with a global shutter."""
        rotations = np.swapaxes(self.rotations, 1, 2)[self.images]
        away = self.points[self.rows] - self.positions[self.images]
        found: Array = camera.project(np.einsum("nij,nj->ni", rotations, away)) - self.pixels
        return found


def _refined(
    given: _Given, camera: Camera, stamps: IntArray, known: Shutter,
    done: Callable[[str], object],
) -> tuple[RefinedMap, ShutterFit | None, IntArray]:  # fmt: skip
    """Motion and shutter, and which images (g,) have a pose."""
    of = most_observed(given.rows, given.images, Effort().adjusted)[given.rows]
    counts = np.bincount(given.images[of], minlength=len(stamps))
    of &= (counts >= LEAST_KEYPOINTS)[given.images]
    if not of.any():
        raise MappingError(
            f"no image of the model shows {LEAST_KEYPOINTS} points that three images see"
        )
    used, images = np.unique(given.images[of], return_inverse=True)
    seen = MapObservations(stamps[used], images, given.rows[of], given.pixels[of])
    start = Start(given.points, given.rotations[used], given.positions[used])
    freedom = colmap_freedom(seen, start, known.lens)
    directions = likely_axes(camera.size, known.scan_direction)
    if known.readout_time is None:
        return *fit_shutter(camera, seen, start, freedom, directions, done), used
    camera = replace(camera, readout_time=known.readout_time, scan_direction=directions[0])
    return refine(camera, seen, start, freedom, done=done), None, used


def _moved(poses: tuple[Array, Array], points: Array) -> Array:
    """Points (n,3) in cameras (n)."""
    moved: Array = np.einsum("nij,nj->ni", poses[0], points) + poses[1]
    return moved
