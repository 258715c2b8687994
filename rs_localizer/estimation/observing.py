"""Which of the given points can be used, and these as the kernels want them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.bearings import bearings
from rs_localizer.core.camera import Camera
from rs_localizer.core.gyro_compensated import gyro_compensated
from rs_localizer.core.known_turn import KnownTurn
from rs_localizer.core.lens import LensError
from rs_localizer.core.simd.jit import kernel
from rs_localizer.estimation.assumptions import Assumed
from rs_localizer.estimation.inputs import distinct, near_image
from rs_localizer.estimation.medians import median_point
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.packing import pack
from rs_localizer.estimation.prior_terms import PriorTerms
from rs_localizer.estimation.sampling import Random

# Points farther away than this (m) are faults, and their squares would be infinite.
_FARTHEST_POINT = 1e9


class Usable(NamedTuple):
    """What can be used of the points."""

    indices: IntArray  # of those that are finite, distinct and inside the image
    shown: BoolArray  # (n,) which lie in the image
    centre: Array  # (3,) map frame: the median of the points
    rays: Array  # (n,2), compensated
    by_ray: Array  # (n,2,2) derivatives of the pixels by them
    tau: Array  # (n,) row times


@dataclass(frozen=True, slots=True, eq=False)
class Sighted:
    """The points of one image as they were given, and what of them can be used."""

    camera: Camera
    points: Array  # (n,3)
    pixels: Array  # (n,2)
    usable: Usable
    turn: KnownTurn | None  # what the rays are compensated by

    def by(self, camera: Camera) -> Observations | None:
        """The same points through another lens; None where it has no bearing for one."""
        rays, by_ray = _rays(camera, self.pixels, self.usable.tau, self.turn)
        if not np.all(np.isfinite(rays[self.usable.indices])):
            return None
        return packed(camera, self.points, self.usable._replace(rays=rays, by_ray=by_ray))


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """The points of one image on their way through the steps, and what is known beside them."""

    observations: Observations
    usable: IntArray  # which of the given points are observed
    count: int  # of the given points
    centre: Array  # (3,) map frame: origin of the observed points
    ranking: IntArray | None  # observed points from the best to the worst
    terms: PriorTerms  # velocity prior and whatever else is known but the pose
    random: Random
    assumed: Assumed
    sighted: Sighted
    lens: LensError | None = None  # what its camera lacked
    asks_lens: bool = False  # what the frame says of that


def find_usable(camera: Camera, points: Array, pixels: Array, turn: KnownTurn | None) -> Usable:
    """Find the usable ones of points (n,3) and pixels (n,2); a known turn is taken out of these."""
    tau = camera.row_time(pixels)
    rays, by_ray = _rays(camera, pixels, tau, turn)
    width, height = camera.size
    shown = near_image(pixels, float(width), float(height))
    centre, candidates = _candidates(points, rays, shown)
    return Usable(distinct(points, pixels, candidates), shown, centre, rays, by_ray, tau)


def _rays(camera: Camera, pixels: Array, tau: Array, turn: KnownTurn | None) -> tuple[Array, Array]:
    """Bearings (n,2) and derivatives (n,2,2) of the pixels by them, compensated."""
    rays, by_ray = bearings(camera, pixels)
    if turn is None:
        return rays, by_ray
    return gyro_compensated(rays, tau, by_ray, camera.row_time_gradient, turn)


@kernel
def _candidates(points: Array, rays: Array, shown: BoolArray) -> tuple[Array, IntArray]:
    """The median (3,) of the points with a bearing, and which of these that are shown are near."""
    count = len(points)
    seen = np.empty(count, dtype=np.bool_)
    for i in range(count):
        seen[i] = np.isfinite(rays[i, 0])
    centre = median_point(points, seen)
    for i in range(count):
        farthest = 0.0
        for axis in range(3):
            farthest = max(farthest, abs(points[i, axis] - centre[axis]))
        seen[i] = seen[i] and shown[i] and farthest < _FARTHEST_POINT
    return centre, np.flatnonzero(seen)


def packed(camera: Camera, points: Array, usable: Usable) -> Observations:
    """The usable points (of these (n,3)), relative to their median."""
    indices, _, centre, rays, by_ray, tau = usable
    found = _packed(points, rays, tau, by_ray, indices, centre)
    near, bearing, times, row_range, lanes = found
    return Observations(near, bearing, times, row_range, camera.row_time_gradient, lanes)


@kernel
def _packed(
    points: Array, rays: Array, tau: Array, by_ray: Array, indices: IntArray, centre: Array
) -> tuple[Array, Array, Array, float, Array]:
    """Points, bearings and row times at these indices, the range of the times, and all packed."""
    near, bearing, times = points[indices], rays[indices], tau[indices]
    for i in range(len(near)):
        for axis in range(3):
            near[i, axis] -= centre[axis]
    row_range = np.max(times) - np.min(times) if len(times) > 0 else 0.0
    return near, bearing, times, row_range, pack(near, bearing, times, by_ray[indices])
