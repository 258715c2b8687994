"""Which of the given points can be used, and these as the kernels want them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.known_turn import KnownTurn
from rs_localizer.core.steadied import steadied
from rs_localizer.estimation.assumptions import Assumed
from rs_localizer.estimation.inputs import distinct, median_point, near_image
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.prior_terms import PriorTerms
from rs_localizer.estimation.sampling import Random

# Points farther away than this (m) are faults, and their squares would be infinite.
_FARTHEST_POINT = 1e9


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
    turn: KnownTurn | None  # what the observations are steadied by


class Usable(NamedTuple):
    """What can be used of the points."""

    indices: IntArray  # of those that are finite, distinct and inside the image
    shown: BoolArray  # (n,) which lie in the image
    centre: Array  # (3,) map frame: the median of the points
    rays: Array  # (n,2), steadied
    by_ray: Array  # (n,2,2) derivatives of the pixels by them


def find_usable(camera: Camera, points: Array, pixels: Array, turn: KnownTurn | None) -> Usable:
    """Find the usable ones of points (n,3) and pixels (n,2); a known turn is taken out of these."""
    rays, by_ray = camera.rays_and_jacobian(pixels)
    if turn is not None:
        gradient = camera.row_time_gradient
        rays, by_ray = steadied(rays, camera.row_time(pixels), by_ray, gradient, turn)
    seen = np.isfinite(rays[:, 0])
    centre = median_point(points, seen)
    with np.errstate(over="ignore"):
        within = np.abs(points - centre).max(axis=1, initial=0.0) < _FARTHEST_POINT
    shown = near_image(camera, pixels)
    indices = distinct(points, pixels, np.flatnonzero(seen & within & shown))
    return Usable(indices, shown, centre, rays, by_ray)


def packed(camera: Camera, points: Array, pixels: Array, usable: Usable) -> Observations:
    """The usable points, relative to their median."""
    indices = usable.indices
    return Observations.of(
        points[indices] - usable.centre,
        usable.rays[indices],
        camera.row_time(pixels[indices]),
        usable.by_ray[indices],
        camera.row_time_gradient,
    )
