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
    adjusted_part,
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
    scale, seen, start = _given(model, [images[name] for name in names], stamps)
    refined, shutter, used = _refined(seen, start, camera, known, done)
    motion = Motion(used, refined.times, refined)
    projected = motion.sights(seen.images, seen.landmarks, seen.pixels)
    posed = np.isin(seen.images, used)
    at, rows, pixels = seen.images[posed], seen.landmarks[posed], seen.pixels[posed]
    points = triangulate(refined.camera, projected, len(start.points)).points
    rotations = np.swapaxes(projected.rotations, 1, 2)
    own = rotations, -np.einsum("nij,nj->ni", rotations, projected.positions)
    in_camera = _moved(own, points[rows])
    errors = np.sum((refined.camera.project(in_camera) - pixels) ** 2, axis=1)
    fits: BoolArray = (errors < (LIMIT * refined.deviation) ** 2) & (in_camera[:, 2] > 0.0)
    fits &= (np.bincount(rows[fits], minlength=len(points)) > 1)[rows]
    at, rows, pixels = at[fits], rows[fits], pixels[fits]
    states = refined.spline.states(refined.times)
    turns = np.swapaxes(states.rotations, 1, 2)
    views = turns, -np.einsum("nij,nj->ni", turns, states.positions)
    place = np.searchsorted(used, at)
    of_each = views[0][place], views[1][place]
    own = own[0][fits], own[1][fits]
    moved = transferred(refined.camera, pixels, own, of_each, in_camera[fits, 2])
    apart = np.linalg.norm(refined.camera.project(_moved(of_each, points[rows])) - moved, axis=1)
    before = _global_errors(camera, seen, start)[posed][fits]
    made = {}
    for k, row in enumerate(used.tolist()):
        mine = at == row
        made[names[row]] = replace(
            images[names[row]],
            rotation=views[0][k],
            translation=views[1][k] / scale,
            pixels=moved[mine] + HALF,
            points=model.ids[rows[mine]],
        )
    shown = np.unique(rows)
    counts = np.bincount(rows, minlength=len(points))
    means = np.bincount(rows, apart, len(points)) / np.maximum(counts, 1)
    return GlobalShutterModel(
        camera=refined.camera_as_found,
        images=made,
        points=Points(model.ids[shown], points[shown] / scale, model.colors[shown], means[shown]),
        refined=refined,
        shutter=shutter,
        keypoints=len(seen.landmarks),
        before=float(np.sqrt(np.mean(before**2))),
        after=float(np.sqrt(np.mean(apart**2))),
    )


def _given(
    model: Model, images: list[ModelImage], stamps: IntArray
) -> tuple[float, MapObservations, Start]:
    """A model as arrays, and how much larger: of a room's size, as priors of motions are in metres.

    Raises:
        MappingError: for keypoints of points that are not there.
    """
    shown = [image.points >= 0 for image in images]
    pairs = list(zip(images, shown, strict=True))
    at = np.repeat(np.arange(len(images)), [np.count_nonzero(some) for some in shown])
    ids = np.concatenate([image.points[some] for image, some in pairs])
    pixels = np.concatenate([image.pixels[some] for image, some in pairs])
    order = np.argsort(model.ids)
    places = np.searchsorted(model.ids[order], ids)
    rows = order[np.minimum(places, len(order) - 1)] if len(order) else np.zeros_like(ids)
    if not len(ids) or np.any(model.ids[rows] != ids):
        raise MappingError("the model's images list no keypoints of its points")
    rotations = np.array([image.rotation.T for image in images])
    translations = np.array([image.translation for image in images])
    positions = -np.einsum("gij,gj->gi", rotations, translations)
    scale = USUAL_DISTANCE / float(
        np.median(np.linalg.norm(model.points[rows] - positions[at], axis=1))
    )
    seen = MapObservations(stamps, at, rows, pixels - HALF)
    return scale, seen, Start(scale * model.points, rotations, scale * positions)


def _global_errors(camera: Camera, seen: MapObservations, start: Start) -> Array:
    """What a model leaves (n,), px, with a global shutter."""
    rotations = np.swapaxes(start.rotations, 1, 2)[seen.images]
    away = start.points[seen.landmarks] - start.positions[seen.images]
    found = camera.project(np.einsum("nij,nj->ni", rotations, away)) - seen.pixels
    return np.asarray(np.linalg.norm(found, axis=1))


def _refined(
    seen: MapObservations, start: Start, camera: Camera, known: Shutter,
    done: Callable[[str], object],
) -> tuple[RefinedMap, ShutterFit | None, IntArray]:  # fmt: skip
    """Motion and shutter, and which images (g,) have a pose."""
    used, seen, start = adjusted_part(seen, start, Effort().adjusted, LEAST_KEYPOINTS)
    if not len(used):
        raise MappingError(
            f"no image of the model shows {LEAST_KEYPOINTS} points that three images see"
        )
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
