# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A model of COLMAP as of a global shutter, for programs that know no other shutter.

Motion and the most useful points are adjusted with the rolling shutter, and all points are
triangulated with that motion. Each keypoint then moves along its own ray, to the depth of its
point, to where a camera at the pose of one row of its image sees that point. The noise of a
keypoint stays.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.rectification import transferred
from rs_localizer.io.maps.colmap import Model, ModelImage, Points
from rs_localizer.tools.adjust.reprojection import LIMIT
from rs_localizer.tools.mapping.build import ViewMotion, usual_size
from rs_localizer.tools.mapping.map_keypoints import ADJUSTED, LEAST_KEYPOINTS, adjusted_part
from rs_localizer.tools.mapping.refinement import (
    RefinedMap,
    colmap_freedom,
    global_errors,
    likely_axis,
    refine_with_shutter,
)
from rs_localizer.tools.mapping.structure import HALF, observed
from rs_localizer.tools.mapping.triangulation import triangulate
from rs_localizer.tools.readout_belief import ReadoutCheck, ShutterFit


@dataclass(frozen=True, slots=True, eq=False)
class GlobalShutterModel:
    """The model, and how it came about."""

    camera: Camera  # with its lens and shutter as they were found
    images: dict[str, ModelImage]  # with the keypoints that fit
    points: Points
    refined: RefinedMap
    shutter: ShutterFit | None  # None: it was given, or too few images follow each other
    readout_check: ReadoutCheck | None  # of a given one
    keypoints: int  # of points, that the model had
    before: float  # px rms, of the keypoints that are kept, in the model as it was
    after: float  # px rms, of the same in this one


def undo_shutter(
    camera: Camera, model: Model, stamps_ns: Mapping[str, int],
    shutter: tuple[float | None, str | None], lens: bool,
) -> GlobalShutterModel:  # fmt: skip
    """Return the model that a global shutter would have given.

    Args:
        camera: of all images; its shutter does not matter.
        model: points and the images that see them.
        stamps_ns: of the images, by their names; no two are the same.
        shutter: readout time, s, None: estimated; and scan direction, None: unknown.
        lens: whether the lens is adjusted.

    Raises:
        ValueError: when the images do not determine it, saying what was found.
    """
    names = sorted(model.images, key=lambda name: stamps_ns[name])
    stamps = np.array([stamps_ns[name] for name in names], np.int64)
    seen, given = observed(model, names, stamps)
    size = usual_size(seen, given)
    start, scale = given.moved(size), size.scale
    used, some, near = adjusted_part(seen, start, ADJUSTED, LEAST_KEYPOINTS)
    if not len(used):
        raise ValueError(
            f"no image of the model shows {LEAST_KEYPOINTS} points that three images see"
        )
    camera = replace(camera, scan_direction=likely_axis(camera.size, shutter[1]))
    refined, found, check = refine_with_shutter(
        camera, some, near, colmap_freedom(lens), shutter[0]
    )
    motion = ViewMotion(used, refined.times, refined)
    projected = motion.sights(seen.images, seen.landmarks, seen.pixels)
    posed = np.isin(seen.images, used)
    at, rows, pixels = seen.images[posed], seen.landmarks[posed], seen.pixels[posed]
    points = triangulate(refined.camera, projected, len(start.points)).points
    own = _camera_from_map(projected.rotations, projected.positions)
    in_camera = _moved(own, points[rows])
    errors = np.sum((refined.camera.project(in_camera) - pixels) ** 2, axis=1)
    fits: BoolArray = (errors < (LIMIT * refined.deviation) ** 2) & (in_camera[:, 2] > 0.0)
    fits &= (np.bincount(rows[fits], minlength=len(points)) > 1)[rows]
    at, rows, pixels = at[fits], rows[fits], pixels[fits]
    turns, places = _camera_from_map(*refined.poses())
    view = np.searchsorted(used, at)
    of_each, own = (turns[view], places[view]), (own[0][fits], own[1][fits])
    moved = transferred(refined.camera, pixels, own, of_each, in_camera[fits, 2])
    apart = np.linalg.norm(refined.camera.project(_moved(of_each, points[rows])) - moved, axis=1)
    before = global_errors(camera, seen, start)[posed][fits]
    made = {}
    for k, row in enumerate(used.tolist()):
        mine = at == row
        made[names[row]] = replace(
            model.images[names[row]], rotation=turns[k], translation=places[k] / scale,
            pixels=moved[mine] + HALF, points=model.ids[rows[mine]],
        )  # fmt: skip
    shown = np.unique(rows)
    counts = np.bincount(rows, minlength=len(points))
    means = np.bincount(rows, apart, len(points)) / np.maximum(counts, 1)
    return GlobalShutterModel(
        camera=refined.camera_as_found, images=made,
        points=Points(model.ids[shown], points[shown] / scale, model.colors[shown], means[shown]),
        refined=refined, shutter=found, readout_check=check, keypoints=len(seen.landmarks),
        before=float(np.sqrt(np.mean(before**2))), after=float(np.sqrt(np.mean(apart**2))),
    )  # fmt: skip


def _camera_from_map(rotations: Array, positions: Array) -> tuple[Array, Array]:
    """Return the inverse of poses map_from_camera (n,3,3), (n,3)."""
    turns = np.swapaxes(rotations, 1, 2)
    return turns, -np.einsum("nij,nj->ni", turns, positions)


def _moved(poses: tuple[Array, Array], points: Array) -> Array:
    """Transform points (n,3) to cameras (n)."""
    return np.asarray(np.einsum("nij,nj->ni", poses[0], points) + poses[1])
