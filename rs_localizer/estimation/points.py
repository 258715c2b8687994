# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The points of one frame: checked, chosen, and packed once for all kernels; planes of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.core import so3
from rs_localizer.core.arrays import (
    Array,
    Array1,
    Array2,
    Array3,
    BoolArray,
    BoolArray1,
    IntArray,
    IntArray1,
    Random,
)
from rs_localizer.core.blocks import median
from rs_localizer.core.camera import numbers
from rs_localizer.core.rig import Exposure, Mounts, Rig
from rs_localizer.core.rotation_prior import RotationPrior, compensated
from rs_localizer.core.shake import shake_at
from rs_localizer.core.simd.tracing import LANES
from rs_localizer.estimation.prior import Assumed, PriorTerms, state_in
from rs_localizer.estimation.projection import (
    AXES,
    CENTRE,
    GRADIENT,
    POINT_SIZE,
    WEIGHT,
    linearized,
    squared_errors,
)
from rs_localizer.native import entry, kernel

if TYPE_CHECKING:
    from rs_localizer.core.types import Estimate
    from rs_localizer.estimation.calibration import LandmarkErrors
    from rs_localizer.estimation.moved_part import MovedParts


@entry
def median_depth(data: Array2, state: Array1, chosen: BoolArray1) -> float:
    depths = np.empty(len(chosen))
    for i in range(len(chosen)):
        block, lane = data[i // LANES], i % LANES
        x, y, z = block[lane], block[LANES + lane], block[2 * LANES + lane]
        depth = 0.0
        for k in range(3):
            place = x * state[3 * k] + y * state[3 * k + 1] + z * state[3 * k + 2] + state[9 + k]
            place -= block[(CENTRE + k) * LANES + lane]
            depth += block[(AXES + 6 + k) * LANES + lane] * place
        depths[i] = depth
    return median(depths[chosen])


# Pixels may lie outside the image by this part of it: noise, and features at its border.
_MARGIN = 0.05


def checked(
    points: ArrayLike, pixels: ArrayLike, scores: ArrayLike | None
) -> tuple[Array, Array, Array | None]:
    """Return points (n,3), pixels (n,2) and scores (n,) as contiguous float64 arrays.

    OpenCV's (n,1,3) and (n,1,2) are taken, too.

    Those that are read-only or unaligned, as Dask sends them, are copied.

    Raises:
        ValueError: wrong shapes, or values that are not finite.
    """
    take = partial(np.require, requirements=["C", "A", "W"])
    points, pixels = numbers("points", points, take), numbers("pixels", pixels, take)
    if points.size == 0 and pixels.size == 0:  # empty lists have no second dimension
        points, pixels = points.reshape(0, 3), pixels.reshape(0, 2)
    points, pixels = (
        array[:, 0] if array.ndim == 3 and array.shape[1] == 1 else array
        for array in (points, pixels)
    )
    n = points.size // 3
    if points.shape != (n, 3) or pixels.shape != (n, 2):
        raise ValueError(
            f"points must be (n,3) and pixels (n,2), got {points.shape} and {pixels.shape}"
        )
    checks = [("points", points), ("pixels", pixels)]
    if scores is not None:
        scores = numbers("scores", scores, take)
        if scores.shape != (n,):
            raise ValueError(f"scores must be ({n},), got {scores.shape}")
        checks.append(("scores", scores))
    for name, array in checks:
        if not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite, found NaN or infinity")
    return points, pixels, scores


def checked_of_rig(
    rig: Rig, parts: Mapping[str, Sequence[ArrayLike]], stamps: Mapping[str, float] | None
) -> tuple[Exposure, list[int], Array, Array, Array | None]:
    """Return exposure, points per camera, and all points, pixels and scores, as :func:`checked`.

    Args:
        parts: (points, pixels) or (points, pixels, scores) by the names of the cameras.
        stamps: s, of the first rows.
    """
    if not parts:
        raise ValueError("the frame has no image")
    exposure, checks = rig.exposure(tuple(parts), stamps), []
    for name, part in parts.items():
        if not isinstance(part, Sequence) or len(part) not in (2, 3):
            raise ValueError(f"{name}: (points, pixels) or (points, pixels, scores) are needed")
        try:
            checks.append(checked(part[0], part[1], part[2] if len(part) == 3 else None))
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
    points, pixels, scores = zip(*checks, strict=True)
    scored = [values for values in scores if values is not None]
    if scored and len(scored) < len(parts):
        raise ValueError("either all images of a frame have scores or none has")
    return (
        exposure,
        [len(each) for each in points],
        np.concatenate(points),
        np.concatenate(pixels),
        np.concatenate(scored) if scored else None,
    )


@entry
def pack(
    points: Array2, rays: Array2, tau: Array1, by_ray: Array3, camera: IntArray1, mounts: Mounts
) -> Array:
    """Pack points (n,3), rays (n,2), row times, derivatives (n,2,2) and cameras (n,) in lanes."""
    count = len(points)
    blocks = (count + LANES - 1) // LANES
    data = np.empty((blocks, POINT_SIZE * LANES))
    for block in range(blocks):
        row = data[block]
        for lane in range(LANES):
            i = min(block * LANES + lane, count - 1)
            for k in range(3):
                row[k * LANES + lane] = points[i, k]
            row[3 * LANES + lane] = rays[i, 0]
            row[4 * LANES + lane] = rays[i, 1]
            row[5 * LANES + lane] = tau[i]
            for k in range(4):
                row[(6 + k) * LANES + lane] = by_ray[i, k // 2, k % 2]
            row[WEIGHT * LANES + lane] = 1.0 if block * LANES + lane < count else 0.0
            mount = camera[i]
            for k in range(2):
                row[(GRADIENT + k) * LANES + lane] = mounts.gradients[mount, k]
            for k in range(9):
                row[(AXES + k) * LANES + lane] = mounts.axes[mount, k // 3, k % 3]
            for k in range(3):
                row[(CENTRE + k) * LANES + lane] = mounts.centres[mount, k]
    return data


@entry
def picked(
    points: Array2, rays: Array2, tau: Array1, by_ray: Array3, camera: IntArray1, mounts: Mounts,
    chosen: IntArray1, origin: Array1,
) -> tuple[Array, Array, Array, Array, IntArray, Array]:  # fmt: skip
    """Return what `pack` takes of chosen points (m,), relative to an origin (3,), and packed."""
    places, own, rows = points[chosen] - origin, rays[chosen], tau[chosen]
    slopes, sides = by_ray[chosen], camera[chosen]
    return places, own, rows, slopes, sides, pack(places, own, rows, slopes, sides, mounts)


@kernel
def weighted(data: Array, weights: Array | BoolArray) -> Array:
    """Return the packed points with these weights (n,): 1 or 0."""
    data = data.copy()
    for i in range(len(weights)):
        data[i // LANES, WEIGHT * LANES + i % LANES] = weights[i]
    return data


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """The points of one frame, ready for the kernels."""

    points: Array  # (n,3) m, in a frame near them
    rays: Array  # (n,2) in the axes of their cameras
    tau: Array  # (n,)
    by_ray: Array  # (n,2,2) derivatives of the pixels
    camera: IntArray  # (n,) which of the mounted sides sees each
    packed: Array
    mounts: Mounts

    @classmethod
    def of(
        cls, points: Array, rays: Array, tau: Array, by_ray: Array, mounts: Mounts,
        camera: IntArray | None = None,
    ) -> Observations:  # fmt: skip
        """Pack points; ``camera`` (n,): None for those of the first one."""
        if camera is None:
            camera = np.zeros(len(points), np.int64)
        packed = pack(points, rays, tau, by_ray, camera, mounts)
        return cls(points, rays, tau, by_ray, camera, packed, mounts)

    def only(self, chosen: IntArray) -> Observations:
        """Return the observations of these points."""
        return Observations(*picked(
            self.points, self.rays, self.tau, self.by_ray, self.camera, self.mounts, chosen,
            np.zeros(3),
        ), self.mounts)  # fmt: skip

    def __len__(self) -> int:
        return len(self.points)

    def lens_of(self, lenses: IntArray | None) -> IntArray | None:
        """Return which camera of a rig sees each point (n,), by that of each side; None: one."""
        return None if lenses is None else lenses[self.camera]

    def squared_errors(self, state: Array) -> Array:
        """Return squared reprojection errors (n,) in raw pixels."""
        errors: Array = squared_errors(self.packed, len(self), state)
        return errors

    def within(self, state: Array, distance: float) -> BoolArray:
        """Return a mask (n,) of points that are reprojected to within a distance (px)."""
        near: BoolArray = squared_errors(self.packed, len(self), state) < distance**2
        return near

    def median_depth(self, state: Array, chosen: BoolArray) -> float:
        """Return the median depth of chosen points (n,) before their cameras; NaN: none."""
        depth: float = median_depth(self.packed, state, chosen)
        return depth


# More points than this only take time.
MOST_POINTS = 2500
NEAREST = 1e-6  # m; points nearer than this would make any map useless


# Points farther away than this (m) are faults, and their squares would be infinite.
_FARTHEST_POINT = 1e9
# A landmark that is matched again within this (px) says nothing new: detectors find a corner on
# several scales. Two inliers of a motion are nearer (twice the default threshold).
_COPY = 4.0


class Usable(NamedTuple):
    """Points that can be used."""

    indices: IntArray  # of those that are finite, no copies and inside the image
    originals: IntArray  # (n,) of which point each is a copy; of itself, if it is none
    shown: BoolArray  # (n,) which lie in the image
    centre: Array  # (3,) map frame: the median of the points
    rays: Array  # (n,2), compensated
    by_ray: Array  # (n,2,2) derivatives of the pixels by them
    tau: Array  # (n,) row times
    camera: IntArray  # (n,) which side of the frame's cameras sees each
    extent: float  # px, of what those of one side fill


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """The points of one image on their way through the steps, and what is known beside them."""

    observations: Observations
    ranking: IntArray  # observed points from the best to the worst; empty: they are alike
    terms: PriorTerms  # velocity prior and whatever else is known but the pose
    random: Random
    assumed: Assumed
    exposure: Exposure
    points: Array  # (n,3) as they were given
    usable: Usable  # what of these can be used
    rotation: RotationPrior | None  # what the rays are compensated by
    error_modes: LandmarkErrors | None = None  # of the map
    parts: MovedParts | None = None  # of the map, that lie elsewhere

    @property
    def centre(self) -> Array:
        """(3,) map frame: origin of the observed points."""
        return self.usable.centre


def find_usable(
    exposure: Exposure,
    points: Array,
    pixels: Array,
    counts: Sequence[int],
    rotation: RotationPrior | None,
) -> Usable:
    """Find the usable ones of points (n,3) and pixels (n,2), so many of each camera in turn.

    A known rotation is taken out of them.
    """
    parts = []
    for place, last in enumerate(accumulate(counts)):
        own = pixels[last - counts[place] : last]
        tau, (rays, by_ray, side) = exposure.row_time(place, own), exposure.look(place, own)
        if rotation is not None:
            gradient = exposure.mounts.gradients[0]  # of a camera alone
            rays, by_ray = compensated(rays, tau, by_ray, gradient, rotation)
        parts.append((rays, by_ray, side, tau))
    rays, by_ray, side, tau = (
        parts[0] if len(parts) == 1 else map(np.concatenate, zip(*parts, strict=True))
    )
    sizes = np.array([each.camera.size for each in exposure.sides], float)
    indices, originals, shown, centre, extent = _select(points, pixels, rays, side, sizes)
    return Usable(indices, originals, shown, centre, rays, by_ray, tau, side, extent)


@entry
def _select(
    points: Array2, pixels: Array2, rays: Array2, side: IntArray1, sizes: Array2
) -> tuple[IntArray, IntArray, BoolArray, Array, float]:
    """Return places of usable points, without copies.

    Args:
        side: (n,) by which each is seen, of a camera with an image of a size (k,2).

    Returns:
        the usable ones (m,); of which each is a copy (n,); which (n,) lie in the image, or as far
        outside as noise may have put them; the median (3,) of the points with a bearing; and width
        or height of what the pixels of a side fill, whichever is the largest.
    """
    count, seen, size = len(points), np.isfinite(rays[:, 0]), sizes[side]
    beyond = _MARGIN * size
    within = (pixels > -beyond) & (pixels < size + beyond)
    shown, centre, extent = within[:, 0] & within[:, 1], np.zeros(3), 0.0
    if np.any(seen):
        for axis in range(3):
            centre[axis] = median(points[:, axis][seen])
    seen &= shown
    for axis in range(3):
        seen &= np.abs(points[:, axis] - centre[axis]) < _FARTHEST_POINT
    for place in range(len(sizes)):
        own = pixels[seen & (side == place)]
        for axis in range(2):
            if len(own) > 0:
                extent = max(extent, np.max(own[:, axis]) - np.min(own[:, axis]))
    # The same landmarks have the same keys.
    keys = points[:, 0] + math.sqrt(2.0) * points[:, 1] + math.sqrt(3.0) * points[:, 2]
    keys[~seen] = np.inf
    order, originals = keys.argsort(kind="mergesort"), np.arange(count)
    for k in range(count):
        one, later = order[k], k + 1
        while seen[one] and later < count and keys[order[later]] == keys[one]:
            other, square = order[later], 0.0
            for axis in range(2):
                square += (pixels[other, axis] - pixels[one, axis]) ** 2
            if square < _COPY**2 and side[other] == side[one]:
                seen[other], originals[other] = False, one
            later += 1
    return np.flatnonzero(seen), originals, shown, centre, extent


class FrameSights(NamedTuple):
    """The points of a frame, checked, and packed for all who ask what a motion leaves of them."""

    exposure: Exposure
    counts: Sequence[int]  # of the points of each camera
    points: Array  # (n,3)
    pixels: Array  # (n,2)
    scores: Array | None  # (n,)
    usable: Usable
    observations: Observations  # the usable ones, relative to their median

    def residuals(self, found: Estimate) -> Array:
        """Return residuals (n,) px by a motion; NaN of unusable points."""
        usable, own = self.usable, self.observations
        state = state_in(found, usable.centre)
        lines = linearized(own.packed, len(own), state, shake_at(own.tau, found.shake))
        errors = np.full(len(self.points), np.nan)
        errors[usable.indices] = np.linalg.norm(lines.errors, axis=1)
        errors[usable.indices[np.isinf(own.squared_errors(state))]] = np.inf
        return errors[usable.originals]


def packed(exposure: Exposure, points: Array, usable: Usable) -> Observations:
    """Pack the usable points (of these (n,3)), relative to their median."""
    return Observations(*picked(
        points, usable.rays, usable.tau, usable.by_ray, usable.camera, exposure.mounts,
        usable.indices, usable.centre,
    ), exposure.mounts)  # fmt: skip


# Points whose depth relief is a smaller part than this of their narrower extent are a plane.
_PLANE = 0.1
# A plane that leans by less (rad) faces the camera.
_LEAST_LEAN = 0.01


@entry
def leaning_less(
    points: Array2, inliers: BoolArray1, state: Array1, leans: float
) -> tuple[bool, Array]:
    """Return True and the state (24,) with the plane's lean reduced so many times.

    Twice its lean less it is mirrored, once it faces the camera. False if the points (n,3) that
    count are no plane, or face the camera.
    """
    plane, centre, axis_of_plane = plane_of(points, inliers)
    if not plane:
        return False, state
    rotation, away = state[:9].copy().reshape(3, 3), state[9:12].copy()
    seen, normal = rotation @ centre + away, rotation @ axis_of_plane
    sight = seen / math.sqrt(np.sum(seen * seen))
    axis = so3.hat_of(sight) @ (np.sign(np.sum(sight * normal)) * normal)
    length = math.sqrt(np.sum(axis * axis))
    lean = math.asin(min(length, 1.0))
    if lean < _LEAST_LEAN:
        return False, state
    flip = so3.exp(-leans * lean / length * axis)
    other = state.copy()
    other[:9], other[9:12] = (flip @ rotation).ravel(), seen + flip @ (away - seen)
    return True, other


@entry
def plane_of(points: Array2, inliers: BoolArray1) -> tuple[bool, Array, Array]:
    """Return True if the counted points lie on a plane, its centre (3,) and normal (3,)."""
    chosen = points[inliers]
    centre = np.zeros(3)
    if len(chosen) == 0:
        return False, centre, centre
    for axis in range(3):
        centre[axis] = np.mean(chosen[:, axis])
    chosen -= centre
    spread = chosen.T @ chosen
    extents, axes = np.linalg.eigh(spread)
    return extents[0] < _PLANE**2 * extents[1], centre, axes[:, 0].copy()
